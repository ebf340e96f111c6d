//! The errors of segmenters.

use std::io;
use std::path::PathBuf;

use slag_models::session::SessionError;

use crate::masks::rle::RleError;

/// Reason why masks cannot be found or read.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    #[error("{}: {source}; write the mask image again", path.display())]
    Png {
        path: PathBuf,
        #[source]
        source: png::DecodingError,
    },
    #[error("{}: found {found} pixels, expected ids; write a PNG with up to 16 bits of gray, or with a palette", path.display())]
    NotIds { path: PathBuf, found: &'static str },
    #[error(
        "{}: {source}; expected SAM's list of masks, each with segmentation {{size, counts}}, or a COCO data set",
        path.display()
    )]
    Json {
        path: PathBuf,
        #[source]
        source: serde_json::Error,
    },
    #[error("{}: {what}; correct it, or export the data set again", path.display())]
    DataSet { path: PathBuf, what: String },
    #[error("{}: mask {index}: {source}", path.display())]
    Rle {
        path: PathBuf,
        index: usize,
        #[source]
        source: RleError,
    },
    #[error(
        "{}: the masks have {} x {} px but the photo of view {view:?} {} x {} px; make the masks from the same photos",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    Size { path: PathBuf, view: String, found_px: [u32; 2], expected_px: [u32; 2] },
    #[error(
        "{}: the bounding boxes of the masks exceed {limit_bytes} px in total; remove stray pixels or give fewer masks",
        path.display()
    )]
    TooLarge { path: PathBuf, limit_bytes: u64 },
    #[error(
        "{}: no masks of any photo: for {view:?} expected a file of that name with the ending .png or .json (or a folder with \
         0.png, 1.png ...), or a COCO file_name like it; found {found}{hint}", path.display()
    )]
    NoMatch { path: PathBuf, view: String, found: String, hint: &'static str },
    #[error("{}: {n} of {of} photos have no masks, the first is {view:?}; make them, or leave out --strict", path.display())]
    Missing { path: PathBuf, view: String, n: usize, of: usize },
    #[error(transparent)]
    Model(Box<SessionError>),
    #[error(
        "view {view:?}: the masks found exceed {limit_bytes} bytes; lower --points-per-side, or raise \
         --sam-predicted-iou and --sam-stability"
    )]
    TooManyMasks { view: String, limit_bytes: u64 },
}

impl From<SessionError> for SegmentError {
    fn from(error: SessionError) -> Self {
        Self::Model(Box::new(error))
    }
}
