//! Which places of a shard's cell are free, occupied or unknown. The byte table is in `docs/formats.md`, the
//! definition in `docs/numerics.md`.
//!
//! Voxel (i, j, k) is the cube from (i, j, k) to (i + 1, j + 1, k + 1) times the voxel's edge, world frame: all
//! shards of a scene share one lattice. 4 x 4 x 4 voxels are a block. Blocks that are not stored are unknown.

mod columns;

#[cfg(test)]
mod tests;

pub(crate) use columns::check;
pub use columns::{
    BLOCK_EDGE, Block, BlockRun, BuiltOccupancy, Occupancy, OccupancyHeader, RunKind, StoredRun, section,
};
