//! Segmentation: finds the masks of a photo.

mod given;
mod graph;
mod sam;
mod standing;

use std::path::{Path, PathBuf};
use std::{fmt, io};

use image::RgbImage;
use rayon::ThreadPool;
use slag_common::{Hash32, View};
use slag_models::session::SessionError;

use crate::ingest::{LoadedImage, Undistorter};
use crate::lanes::GpuLoad;
use crate::masks::Mask;

pub use given::{GivenMasks, file_of as mask_file};
pub use graph::{GraphSegmenter, GraphSettings};
pub use sam::{SamLevels, SamSegmenter, SamSettings, ScoreFilter};
pub(crate) use standing::WithStanding;

/// Limit on a view's masks: the total area of their boxes, one byte per pixel.
pub(super) const MAX_MASK_BYTES: u64 = 1 << 30;

pub trait Segmenter: Sync {
    /// Method, every parameter, and hashes of the weights. Segmenters of equal identity find the same masks in a photo
    /// if [`Self::identity_of_view`] is equal, too.
    fn identity(&self) -> String;

    /// Hash of what the view's masks come from beside the photo: its mask file; `None` if nothing.
    fn identity_of_view(&self, _view: &View) -> Result<Option<Hash32>, SegmentError> {
        Ok(None)
    }

    /// Checks that views have masks, for masks that exist already; returns a sentence on those without.
    fn check_views(&self, _views: &[View], _strict: bool) -> Result<Option<String>, SegmentError> {
        Ok(None)
    }

    /// Whether it uses [`SegmentInput::depth`], which costs a drawing of the scene.
    fn wants_depth(&self) -> bool {
        false
    }

    /// Photos that its own threads or device process at once; `None` if it works on the caller's thread.
    fn concurrency(&self) -> Option<usize> {
        None
    }

    /// Load of each GPU that runs its models; none on the processor.
    fn loads(&self) -> Vec<GpuLoad> {
        Vec::new()
    }

    /// Masks may overlap.
    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError>;
}

#[derive(Clone, Copy, Debug)]
pub struct SegmentInput<'a> {
    /// With the intrinsics of `image` (an ideal pinhole).
    pub view: &'a View,
    pub image: &'a RgbImage,
    /// Pixels inside the lens image, row-major; `None` if all are.
    pub valid: Option<&'a [bool]>,
    /// Mapping that undistorted the photo, to apply to existing masks.
    pub undistorter: Option<&'a Undistorter>,
    /// Depth of the scene, camera z per pixel of `image`, row-major; 0 or NaN if unknown.
    pub depth: Option<&'a [f32]>,
    /// Threads for [`Self::install`]. A segmenter with its own threads must not be called from one of these: it would
    /// wait for itself.
    pub pool: Option<&'a ThreadPool>,
}

impl<'a> SegmentInput<'a> {
    /// Without a pool.
    pub fn new(loaded: &'a LoadedImage, depth: Option<&'a [f32]>) -> Self {
        Self {
            view: &loaded.view,
            image: &loaded.image,
            valid: loaded.valid.as_deref(),
            undistorter: loaded.undistorter.as_ref(),
            depth,
            pool: None,
        }
    }

    /// Runs work, with its parallel iterators, on the pool's threads; without a pool, on the caller's.
    pub(super) fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        match self.pool {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }
}

#[derive(Clone, Copy, Debug)]
pub struct NoMasks;

impl Segmenter for NoMasks {
    fn identity(&self) -> String {
        "no masks".into()
    }

    fn segment(&self, _input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        Ok(Vec::new())
    }
}

#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// What is wrong with a file of masks, and what to do.
    #[error("{}: {problem}", path.display())]
    File { path: PathBuf, problem: String },
    #[error("view {view}: {problem}")]
    View { view: String, problem: String },
    #[error(
        "{}: the masks have {} x {} px but the photo of view {view:?} {} x {} px; make the masks from the same photos",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    Size { path: PathBuf, view: String, found_px: [u32; 2], expected_px: [u32; 2] },
    #[error(transparent)]
    Model(Box<SessionError>),
}

impl SegmentError {
    fn of_file(path: &Path, problem: impl fmt::Display) -> Self {
        Self::File { path: path.to_owned(), problem: problem.to_string() }
    }
}

impl From<SessionError> for SegmentError {
    fn from(error: SessionError) -> Self {
        Self::Model(Box::new(error))
    }
}
