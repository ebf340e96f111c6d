//! The input of the search for objects.

use std::sync::atomic::{AtomicBool, Ordering};

use slag_common::Gaussians;

use crate::cells::CellSplit;
use crate::codebook::ScoreMetricContext;
use crate::lift::photos::Photo;
use crate::lift::superpoint::Superpoints;
use crate::lift::{ContributionIndex, RegionTable};

/// A scene to find objects in.
pub struct Scene<'a> {
    /// The contributions of all views.
    pub index: &'a ContributionIndex,
    /// Their regions.
    pub table: &'a RegionTable,
    /// The Gaussians.
    pub gaussians: &'a Gaussians,
    /// Their cells.
    pub split: &'a CellSplit,
    /// The pieces of surface that objects are made of. If absent, they are found from colour and shape.
    pub superpoints: Option<&'a Superpoints>,
    /// Each view's masks, in the order of the contributions.
    pub photos: &'a [Photo],
    /// Texts to calibrate scores by.
    pub score_context: &'a ScoreMetricContext,
    /// Bytes for the contributions of a group of parts.
    pub group_bytes: u64,
    /// Set when the user asks to stop.
    pub cancel: &'a AtomicBool,
}

impl Scene<'_> {
    pub(super) fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }

    /// Returns the view of each mask.
    pub(super) fn view_of_mask(&self) -> Vec<u32> {
        repeat_each(self.index.n_masks_of_view())
    }

    /// Returns the view of each region.
    pub(super) fn view_of_region(&self) -> Vec<u32> {
        repeat_each(self.index.n_regions_of_view())
    }
}

/// Returns each index, repeated as often as its count.
fn repeat_each(counts: impl Iterator<Item = usize>) -> Vec<u32> {
    counts.zip(0u32..).flat_map(|(n, i)| std::iter::repeat_n(i, n)).collect()
}
