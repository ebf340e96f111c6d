//! A mask that the filters judge.

use super::runs::RunMask;
use crate::masks::BoxPx;

#[derive(Clone, Debug)]
pub(super) struct Candidate {
    pub(super) mask: RunMask,
    /// IoU with the true mask, predicted by the model.
    pub(super) predicted_iou: f32,
    /// IoU of the mask with itself under a higher and a lower threshold.
    pub(super) stability: f64,
    /// 0 whole, 1 part, 2 subpart.
    pub(super) level: u8,
    /// The crop of the image in which the mask was found.
    pub(super) crop: BoxPx,
}

impl Candidate {
    pub(super) fn score(&self) -> f64 {
        f64::from(self.predicted_iou) * self.stability
    }
}
