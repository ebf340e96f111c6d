//! Segmentation: finds the masks of a photo.

mod given;
mod graph;
mod sam;
mod segmenter;
mod standing;

pub use given::{GivenMasks, file_of as mask_file};
pub use graph::{GraphSegmenter, GraphSettings};
pub use sam::{SamLevels, SamSegmenter, SamSettings, ScoreFilter};
pub use segmenter::{NoMasks, SegmentError, SegmentInput, Segmenter};
pub(crate) use standing::WithStanding;
