//! Segmentation: finds the masks of a photo.

mod colour;
mod error;
mod given;
mod graph;
mod none;
mod sam;
mod segmenter;
mod standing;
mod support;

pub use error::SegmentError;
pub use given::{GivenMasks, file_of as mask_file};
pub use graph::{GraphSegmenter, GraphSettings};
pub use none::NoMasks;
pub use sam::{SamLevels, SamSegmenter, SamSettings, ScoreFilter};
pub use segmenter::{SegmentInput, Segmenter};
pub(crate) use standing::WithStanding;
