//! What was drawn in a view.

use crate::bin::Tiles;
use crate::buckets::Buckets;
use crate::project::Projection;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewCounters {
    /// Gaussians with a pixel of the image in their footprint; they may be occluded.
    pub visible: usize,
    /// Number of (Gaussian, tile) pairs.
    pub pairs: usize,
    /// Gaussians that cannot be drawn: not finite, without a rotation, or beyond the range of `f32` once
    /// projected.
    pub unusable: usize,
}

impl ViewCounters {
    pub fn of(projection: &Projection, tiles: &Tiles) -> Self {
        Self {
            visible: projection.visible.len(),
            pairs: tiles.rows.iter().map(Buckets::n_items).sum(),
            unusable: projection.unusable,
        }
    }
}
