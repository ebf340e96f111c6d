//! No masks, for regions that are patches of the image model alone.

use super::error::SegmentError;
use super::segmenter::{SegmentInput, Segmenter};
use crate::masks::Mask;

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
