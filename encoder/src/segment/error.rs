//! The errors of segmenters.

use std::io;
use std::path::PathBuf;

use slag_models::session::SessionError;

use crate::masks::rle::RleError;

/// Reason why masks cannot be found or read.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    /// A file cannot be read; the message contains its path.
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// A mask image is damaged.
    #[error("{}: {source}; write the mask image again", path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// The decoder's error.
        #[source]
        source: png::DecodingError,
    },
    /// A mask image contains colours instead of ids.
    #[error("{}: found {found} pixels, expected ids; write a PNG with up to 16 bits of gray, or with a palette", path.display())]
    NotIds {
        /// The file.
        path: PathBuf,
        /// Its pixel format.
        found: &'static str,
    },
    /// A mask file is not JSON of the expected form.
    #[error(
        "{}: {source}; expected SAM's list of masks, each with segmentation {{size, counts}}, or a COCO data set",
        path.display()
    )]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        #[source]
        source: serde_json::Error,
    },
    /// A mask of a JSON file cannot be used.
    #[error("{}: mask {index}: {source}", path.display())]
    Rle {
        /// The file.
        path: PathBuf,
        /// Index in the file's list.
        index: usize,
        /// The mask's error.
        #[source]
        source: RleError,
    },
    /// A mask and its image differ in size.
    #[error(
        "{}: the masks have {} x {} px but the photo of view {view:?} {} x {} px; make the masks from the same photos",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Width and height of the masks.
        found_px: [u32; 2],
        /// Width and height of the photo.
        expected_px: [u32; 2],
    },
    /// The masks of a view exceed the memory limit.
    #[error(
        "{}: the bounding boxes of the masks exceed {limit_bytes} px in total; remove stray pixels or give fewer masks",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Limit on the total area of the masks' bounding boxes.
        limit_bytes: u64,
    },
    /// A segmentation model failed; the photo is not the cause.
    #[error(transparent)]
    Model(Box<SessionError>),
    /// The masks that a model found exceed the memory limit.
    #[error(
        "view {view:?}: the masks found exceed {limit_bytes} bytes; lower --points-per-side, or raise \
         --sam-predicted-iou and --sam-stability"
    )]
    TooManyMasks {
        /// The view.
        view: String,
        /// Limit on the size of the masks.
        limit_bytes: u64,
    },
}

impl From<SessionError> for SegmentError {
    fn from(error: SessionError) -> Self {
        Self::Model(Box::new(error))
    }
}
