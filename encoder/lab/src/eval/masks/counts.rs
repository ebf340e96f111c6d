//! Pixels of masks, and sums of intersections over union.

use serde::Serialize;
use slag_encoder::masks::{NO_REGION, RegionMap};

use crate::table::percent;

/// Masks and labelled segments with fewer pixels do not count, as in `encode`.
pub(super) const MIN_PX: u32 = 200;

pub(super) fn areas(
    regions: &RegionMap,
    masks_of_region: &[Vec<u32>],
    counts: impl Fn(usize) -> bool,
) -> Vec<u64> {
    let n = masks_of_region.iter().flatten().max().map_or(0, |most| *most as usize + 1);
    let mut areas = vec![0; n];
    let pixels = regions.region_of_pixel.iter().enumerate();
    for (_, region) in pixels.filter(|(pixel, region)| **region != NO_REGION && counts(*pixel)) {
        masks_of_region[*region as usize].iter().for_each(|mask| areas[*mask as usize] += 1);
    }
    areas
}

/// The best masks' intersections over union of some segments.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Ious {
    pub(super) n: usize,
    pub(super) sum: f64,
    pub(super) n_above_half: usize,
}

impl Ious {
    pub(super) fn add(&mut self, iou: f64) {
        self.n += 1;
        self.sum += iou;
        self.n_above_half += usize::from(iou >= 0.5);
    }

    pub(super) fn mean(&self) -> Option<f64> {
        (self.n > 0).then(|| self.sum / self.n as f64)
    }

    pub(super) fn found(&self) -> String {
        percent(self.n_above_half as u64, self.n as u64)
    }
}
