//! The lattice of voxels and blocks, common to all shards of a scene.

use glam::DVec3;
use slag_common::occupancy::BLOCK_EDGE;

/// Farthest block from the world's origin: twice this distance still fits 32 bits of voxels.
const MAX_BLOCK: f64 = (1u64 << 26) as f64;

/// Ordered by x, then y, then z.
pub(super) type BlockAt = [i32; 3];

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lattice {
    /// Edge of a voxel, world units.
    pub(super) voxel: f64,
}

impl Lattice {
    /// A point in voxels; `None` beyond the lattice.
    pub(super) fn in_voxels(self, point: DVec3) -> Option<DVec3> {
        let at = point / self.voxel;
        (at.abs().max_element() < MAX_BLOCK * f64::from(BLOCK_EDGE)).then_some(at)
    }

    pub(super) fn block(self) -> f64 {
        self.voxel * f64::from(BLOCK_EDGE)
    }

    pub(super) fn corner(self, at: BlockAt) -> DVec3 {
        DVec3::from(at.map(f64::from)) * self.block()
    }

    pub(super) fn centre(self, at: BlockAt) -> DVec3 {
        self.corner(at) + self.block() / 2.0
    }
}
