//! Why an encode ends without a new generation.

use std::path::PathBuf;

use slag_common::poses::PoseError;
use slag_common::splat::SplatError;
use slag_models::{ModelError, TextSideError};

use crate::embed::EmbedError;
use crate::ingest::{GeoError, IngestError};
use crate::landmarks::LandmarkError;
use crate::lift::ContributionError;
use crate::memory::MemoryError;
use crate::raster::RasterError;
use crate::segment::SegmentError;
use crate::store::{StoreError, io_help, records_help};
use crate::viewpoints::ViewpointError;

#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    #[error("{setting}: {problem}")]
    Setting { setting: String, problem: String },
    #[error("--text-model: {0}")]
    TextModel(#[from] TextSideError),
    #[error(transparent)]
    Splat(#[from] SplatError),
    #[error(transparent)]
    Poses(#[from] PoseError),
    #[error(transparent)]
    Geo(#[from] GeoError),
    #[error(transparent)]
    Viewpoints(#[from] ViewpointError),
    #[error(transparent)]
    Ingest(#[from] IngestError),
    #[error(transparent)]
    Segment(#[from] SegmentError),
    #[error(transparent)]
    Scene(#[from] RasterError),
    #[error("view {view}: {source}")]
    Raster { view: String, source: RasterError },
    #[error("view {view}: {source}")]
    Landmarks { view: String, source: LandmarkError },
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("view {view}: {source}")]
    Embed { view: String, source: EmbedError },
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error(transparent)]
    Contributions(#[from] ContributionError),
    #[error("{0}; {help}", help = io_help(.0))]
    Io(#[from] std::io::Error),
    #[error("job records: {0}; {help}", help = records_help(.0, "start over with --restart"))]
    Records(#[from] sled::Error),
    #[error(
        "{}: holds an unfinished encode of another splat or with other settings ({n_done} views done); finish it with its own \
         splat and settings, or drop it with --restart", path.display()
    )]
    OtherJob { path: PathBuf, n_done: usize },
    #[error(
        "view {view}: its photo or masks changed after the encode began; leave the files alone, and encode again"
    )]
    Changed { view: String },
    /// A message that says what to do.
    #[error("{0}")]
    Failed(String),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[cfg(feature = "fleet")]
    #[error(transparent)]
    Blob(#[from] crate::blobs::BlobError),
    #[error("interrupted after {n_done} of {n_views} views; run the same command again to resume")]
    Interrupted { n_done: usize, n_views: usize },
}

impl EncodeError {
    pub(super) fn no_views(n_views: usize, reason: &str) -> Self {
        Self::Failed(format!("none of {n_views} views can be used; the first: {reason}"))
    }

    /// Returns whether one view's input is at fault, so that the other views may go on.
    pub(crate) fn is_of_one_view(&self) -> bool {
        match self {
            Self::Ingest(_)
            | Self::Changed { .. }
            | Self::Contributions(ContributionError::TooManyRegions { .. }) => true,
            Self::Segment(error) => !matches!(error, SegmentError::Model(_)),
            Self::Embed { source, .. } => source.is_of_crops(),
            _ => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use slag_models::InferenceError;

    use super::*;

    /// Too many masks, overflow of half precision on some photos, and a crop without pixels or with a zero vector must
    /// not end the encode of all others at every resume; a model that fails on one view fails on others.
    #[test]
    fn what_one_view_is_at_fault_for() {
        let path = PathBuf::new();
        let many = ContributionError::TooManyRegions { path: path.clone(), found: usize::MAX };
        assert!(EncodeError::from(many).is_of_one_view());
        assert!(
            EncodeError::from(SegmentError::View { view: "a".into(), problem: "many".into() })
                .is_of_one_view()
        );
        let of = |cause: InferenceError| {
            let source = EmbedError::Encode { first: 3, last: 3, cause: Box::new(cause) };
            EncodeError::Embed { view: "a".into(), source }.is_of_one_view()
        };
        assert!(of(InferenceError::EmptyCrop { index: 3 }));
        assert!(of(InferenceError::NoDirection { model: "m".into(), index: 3 }));
        assert!(!of(InferenceError::Session(ModelError(String::new()))));
    }
}
