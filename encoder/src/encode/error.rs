//! Why an encode ends without a new generation.

use std::path::PathBuf;

use slag_common::poses::PoseError;
use slag_common::splat::SplatError;
use slag_models::{ModelError, TextSideError};

use crate::embed::EmbedError;
use crate::ingest::{GeoError, IngestError};
use crate::lift::ContributionError;
use crate::memory::MemoryError;
use crate::raster::RasterError;
use crate::segment::SegmentError;
use crate::store::StoreError;

/// Why an encode ended without a new generation.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// A setting is out of its range.
    #[error("{setting}: {problem}")]
    Setting {
        /// The setting's name.
        setting: &'static str,
        /// What is wrong with it, and what is expected.
        problem: String,
    },
    /// Patches are asked for, but the image model has none.
    #[error(
        "{model} has no vectors of patches; give a model whose model.toml has image.patches, or leave --regions out"
    )]
    NoPatches {
        /// The model.
        model: String,
    },
    /// The store cannot carry the text model.
    #[error("--text-model: {0}")]
    TextModel(#[from] TextSideError),
    /// The worker threads cannot be started.
    #[error("cannot start {n_threads} threads: {source}; use fewer with --threads")]
    Threads {
        /// Threads asked for.
        n_threads: usize,
        /// The cause.
        source: rayon::ThreadPoolBuildError,
    },
    /// The scene cannot be read.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// The poses cannot be read.
    #[error(transparent)]
    Poses(#[from] PoseError),
    /// The geo-reference cannot be read.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// A photo cannot be read, and `strict` is set.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// Masks cannot be made or read.
    #[error(transparent)]
    Segment(#[from] SegmentError),
    /// The scene cannot be rasterised.
    #[error(transparent)]
    Scene(#[from] RasterError),
    /// A view cannot be rasterised.
    #[error("view {view}: {source}")]
    Raster {
        /// The view.
        view: String,
        /// The cause.
        source: RasterError,
    },
    /// A model cannot be opened.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A model failed on a view's crops.
    #[error("view {view}: {source}")]
    Embed {
        /// The view.
        view: String,
        /// The cause.
        source: EmbedError,
    },
    /// The store cannot be read or written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A file of contributions is damaged or cannot be written.
    #[error(transparent)]
    Contributions(#[from] ContributionError),
    /// A working file cannot be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The job records cannot be read or written.
    #[error("{}: job records: {source}; start over with --restart", path.display())]
    Records {
        /// The store.
        path: PathBuf,
        /// The database's error.
        source: sled::Error,
    },
    /// The store holds an unfinished encode of another scene or with other settings.
    #[error(
        "{}: holds an unfinished encode of another splat or with other settings ({n_done} views done); finish it with its own \
         splat and settings, or drop it with --restart", path.display()
    )]
    OtherJob {
        /// The store.
        path: PathBuf,
        /// Views that it finished.
        n_done: usize,
    },
    /// Photos are missing, and `strict` is set.
    #[error("{n_missing} of {n_views} photos are missing, the first is {}; give their folder with --images", first.display())]
    MissingImages {
        /// Photos missing.
        n_missing: usize,
        /// Views in the poses file.
        n_views: usize,
        /// The first missing photo.
        first: PathBuf,
    },
    /// Two poses files name the same view.
    #[error("{}: view {view} has a pose already in {}; give the photos other names, or leave one of the files out", path.display(), first.display())]
    AddedTwice {
        /// The view.
        view: String,
        /// The poses file that was given first.
        first: PathBuf,
        /// The one that was added.
        path: PathBuf,
    },
    /// Poses that are added are in another frame.
    #[error("{}: applied_transform or applied_scale differ from those of {}; bring both poses into one frame", path.display(), first.display())]
    AddedFrame {
        /// The poses file that was given first.
        first: PathBuf,
        /// The one that was added.
        path: PathBuf,
    },
    /// A view to leave out is in no poses file.
    #[error("--drop {view}: no poses file has this view; its first view is {first:?}")]
    NoViewToDrop {
        /// The name as given.
        view: String,
        /// A view that there is.
        first: String,
    },
    /// No view can be used.
    #[error("none of {n_views} views can be used; the first: {reason}")]
    NoViews {
        /// Views in the poses file.
        n_views: usize,
        /// Why the first one cannot be used.
        reason: String,
    },
    /// The scene has no usable Gaussian.
    #[error("{}: hardly any of {n_gaussians} Gaussians can be seen (finite, positive scales, a rotation, not transparent); export the splat again", path.display())]
    NoGaussians {
        /// The splat file.
        path: PathBuf,
        /// Gaussians in it.
        n_gaussians: usize,
    },
    /// A view has no pose, and `strict` is set.
    #[error("view {view} has no pose: {reason}; remove it from the poses, or leave out --strict")]
    NoPose {
        /// The view.
        view: String,
        /// What its pose is.
        reason: String,
    },
    /// No Gaussian has an embedding.
    #[error(
        "no Gaussian of the scene lies in any mask: robots would find nothing; check the masks and the poses \
         (`slag-encoder check`), or publish all the same with --allow-empty"
    )]
    NoEvidence,
    /// The memory budget is too small.
    #[error(transparent)]
    Memory(#[from] MemoryError),
    /// The bucket or the fleet.
    #[error(transparent)]
    Fleet(Box<dyn std::error::Error + Send + Sync>),
    /// The user stopped the encode; a rerun resumes.
    #[error("interrupted after {n_done} of {n_views} views; run the same command again to resume")]
    Interrupted {
        /// Views finished.
        n_done: usize,
        /// Views in all.
        n_views: usize,
    },
}

impl EncodeError {
    /// Returns whether the error lies in one view's input, so that the other views may go on.
    pub(crate) fn is_of_one_view(&self) -> bool {
        match self {
            Self::Ingest(_) | Self::Contributions(ContributionError::TooManyRegions { .. }) => true,
            Self::Segment(error) => !matches!(error, SegmentError::Model(_)),
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One view with too many masks must not end the encode of all others, at every resume.
    #[test]
    fn too_many_regions_are_one_views_fault() {
        let error = ContributionError::TooManyRegions { path: PathBuf::new(), found: usize::MAX };
        assert!(EncodeError::from(error).is_of_one_view());
    }
}
