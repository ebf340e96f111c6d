//! Stage 1: masks of an image, and the partition of the image that they make.

mod given;
mod graph;
mod sam;

use std::io;
use std::path::PathBuf;

use image::RgbImage;
use slag_common::View;
use slag_models::session::SessionError;

use crate::ingest::{LoadedImage, Undistorter};
use crate::masks::Mask;
use crate::masks::rle::RleError;

pub use given::GivenMasks;
pub use graph::{GraphSegmenter, GraphSettings};
pub use sam::{SamSegmenter, SamSettings};

/// Most pixels that the boxes of a view's masks may have in all; a byte each.
const MAX_MASK_BYTES: u64 = 1 << 30;

/// Finds the masks of an image.
pub trait Segmenter: Sync {
    /// Returns what identifies the segmenter's results: its method and every parameter of it.
    fn name(&self) -> &str;

    /// Returns a text that differs where masks may differ: the name, and hashes of weights or of files of masks.
    ///
    /// # Errors
    /// [`SegmentError::Io`] if a file of masks cannot be read.
    fn identity(&self) -> Result<String, SegmentError> {
        Ok(self.name().to_owned())
    }

    /// Returns whether it looks at [`SegmentInput::depth`], which takes a drawing of the scene.
    fn wants_depth(&self) -> bool {
        false
    }

    /// Returns how many images a model or device of its own works on at once; `None` on the processor.
    fn n_lanes(&self) -> Option<usize> {
        None
    }

    /// Returns the masks of an image; they may overlap.
    ///
    /// # Errors
    /// [`SegmentError`] if masks cannot be made or read.
    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError>;
}

/// What a segmenter may look at.
#[derive(Clone, Copy, Debug)]
pub struct SegmentInput<'a> {
    /// The view, its intrinsics those of `image`: an ideal pinhole.
    pub view: &'a View,
    /// The photo, free of distortion.
    pub image: &'a RgbImage,
    /// Pixels that show something, row-major; `None` where all do.
    pub valid: Option<&'a [bool]>,
    /// How the photo was freed of distortion, for masks that were made before.
    pub undistorter: Option<&'a Undistorter>,
    /// The scene's own depth, camera z per pixel of `image`, row-major; 0 or NaN where there is none.
    pub depth: Option<&'a [f32]>,
}

impl<'a> SegmentInput<'a> {
    /// Returns the input that a loaded photo makes, with depth or without.
    pub fn new(loaded: &'a LoadedImage, depth: Option<&'a [f32]>) -> Self {
        Self {
            view: &loaded.view,
            image: &loaded.image,
            valid: loaded.valid.as_deref(),
            undistorter: loaded.undistorter.as_ref(),
            depth,
        }
    }
}

/// Why masks could not be made or read.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    /// A file could not be read; the message has its path.
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// A mask image is damaged.
    #[error("{}: {source}; write the mask image again", path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// The decoder's reason.
        #[source]
        source: png::DecodingError,
    },
    /// A mask image has colours instead of ids.
    #[error("{}: {found} pixels; give ids: a PNG of 8 or 16 bit gray, or with a codebook", path.display())]
    NotIds {
        /// The file.
        path: PathBuf,
        /// The kind of its pixels.
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
        /// Position in the file's list, counted from 0.
        index: usize,
        /// The reason.
        #[source]
        source: RleError,
    },
    /// A mask is of another size than its image.
    #[error(
        "{}: masks of {} x {} px, but the image of view {view:?} is {} x {} px; make the masks from these images",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Width and height of the masks.
        found_px: [u32; 2],
        /// Width and height of the image.
        expected_px: [u32; 2],
    },
    /// The masks of one view need more memory than is allowed.
    #[error(
        "{}: the masks of one view cover more than {limit_bytes} pixels in all; leave out the specks or give fewer masks",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The limit: the sum over the masks of their boxes' areas.
        limit_bytes: u64,
    },
    /// A segmentation model failed: no fault of the image.
    #[error(transparent)]
    Model(Box<SessionError>),
    /// A model finds more masks than is allowed.
    #[error(
        "view {view:?}: the masks found take more than {limit_bytes} bytes; ask for fewer points, or be stricter          with --sam-predicted-iou and --sam-stability"
    )]
    TooManyMasks {
        /// The view.
        view: String,
        /// The limit.
        limit_bytes: u64,
    },
}

impl From<SessionError> for SegmentError {
    fn from(error: SessionError) -> Self {
        Self::Model(Box::new(error))
    }
}
