//! The columns of a shard's occupancy.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::container;

/// Voxels along an edge of a block.
pub const BLOCK_EDGE: i32 = 4;
/// Bits of a stored run that name its kind.
pub(super) const KIND_BITS: u32 = 2;

/// Section ids.
pub mod section {
    /// [`super::OccupancyHeader`].
    pub const HEADER: u32 = 50;
    /// `[n_runs]` [`super::StoredRun`].
    pub const RUNS: u32 = 51;
    /// `[n_mixed][2]` u64: occupied voxels and free voxels of each mixed block, in the order of the runs.
    pub const MASKS: u32 = 52;
}

/// The fixed-size header of the occupancy.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct OccupancyHeader {
    /// Edge of a voxel, world units.
    pub voxel: f64,
    /// Smallest block along each axis: block b begins at voxel 4 b.
    pub first_block: [i32; 3],
    /// Blocks along each axis.
    pub n_blocks: [u32; 3],
    pub n_runs: u32,
    /// Blocks with masks of their own.
    pub n_mixed: u32,
    /// Opacity from which a voxel is occupied.
    pub min_opacity: f32,
    /// Views that must have looked through a free voxel, at least.
    pub min_views: u32,
}

/// What is known of a voxel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VoxelState {
    /// Nothing: no view has looked there.
    Unknown,
    /// Views have looked through it, and nothing is there.
    Free,
    Occupied,
}

/// The state of the blocks of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunKind {
    Free = 1,
    Occupied = 2,
    Mixed = 3,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct StoredRun {
    /// Index of the first block: `z + n_z (y + n_y x)`, from the smallest block on.
    pub start: u32,
    /// Blocks, times 4, plus the [`RunKind`].
    pub len_and_kind: u32,
}

impl StoredRun {
    /// Returns the kind; `None` if there is no such kind.
    pub(super) fn kind(self) -> Option<RunKind> {
        match self.len_and_kind & ((1 << KIND_BITS) - 1) {
            1 => Some(RunKind::Free),
            2 => Some(RunKind::Occupied),
            3 => Some(RunKind::Mixed),
            _ => None,
        }
    }

    pub(super) fn len(self) -> u32 {
        self.len_and_kind >> KIND_BITS
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockRun<'a> {
    /// Indices of the blocks, see [`StoredRun::start`].
    pub blocks: Range<u32>,
    pub kind: RunKind,
    /// `[blocks.len()]`, if the blocks are mixed: occupied and free voxels.
    pub masks: &'a [[u64; 2]],
}

impl BlockRun<'_> {
    /// Returns occupied and free voxels of one of the run's blocks.
    pub fn masks_of(&self, block: u32) -> [u64; 2] {
        match self.kind {
            RunKind::Free => [0, !0],
            RunKind::Occupied => [!0, 0],
            RunKind::Mixed => self.masks[(block - self.blocks.start) as usize],
        }
    }
}

/// The occupancy's columns, borrowed from a shard's bytes or from the data to be written.
#[derive(Clone, Copy, Debug)]
pub struct Occupancy<'a> {
    pub header: OccupancyHeader,
    /// `[n_runs]`, ascending.
    pub runs: &'a [StoredRun],
    /// `[n_mixed]`: occupied and free voxels; bit `z + 4 (y + 4 x)` is the voxel (x, y, z) of the block.
    pub masks: &'a [[u64; 2]],
}

impl<'a> Occupancy<'a> {
    /// Returns the sections, to be written after the shard's own.
    pub fn sections(&self) -> [(u32, &[u8]); 3] {
        [
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::RUNS, container::bytes_of(self.runs)),
            (section::MASKS, container::bytes_of(self.masks)),
        ]
    }

    /// Returns the runs of blocks, ascending. A run may be long: readers clip it before they go through its
    /// blocks.
    pub fn runs(&self) -> impl Iterator<Item = BlockRun<'a>> + 'a {
        let mut masks = self.masks;
        self.runs.iter().filter_map(move |run| {
            let kind = run.kind()?;
            let n_masks = if kind == RunKind::Mixed { run.len() as usize } else { 0 };
            let (of_run, rest) = masks.split_at_checked(n_masks)?;
            masks = rest;
            Some(BlockRun { blocks: run.start..run.start + run.len(), kind, masks: of_run })
        })
    }

    /// Returns the block of an index, on the scene's lattice.
    pub fn block_at(&self, index: u32) -> [i32; 3] {
        let [_, n_y, n_z] = self.header.n_blocks;
        let (x, y, z) = (index / n_z / n_y, index / n_z % n_y, index % n_z);
        let first = self.header.first_block;
        [first[0] + x as i32, first[1] + y as i32, first[2] + z as i32]
    }
}

/// Returns the state of a voxel of a block from its masks. `voxel`: 0..4 each.
pub(super) fn state_of(masks: [u64; 2], [x, y, z]: [i32; 3]) -> VoxelState {
    let bit = 1u64 << (z + BLOCK_EDGE * (y + BLOCK_EDGE * x));
    match (masks[0] & bit != 0, masks[1] & bit != 0) {
        (true, _) => VoxelState::Occupied,
        (false, true) => VoxelState::Free,
        (false, false) => VoxelState::Unknown,
    }
}

impl Occupancy<'_> {
    /// Returns the state of a voxel of the scene's lattice. Goes through the runs: for tests and judges, not for
    /// maps.
    pub fn state(&self, voxel: [i32; 3]) -> VoxelState {
        let block = voxel.map(|v| v.div_euclid(BLOCK_EDGE));
        let of_run = |run: BlockRun<'_>| {
            let index = self.index_of(block).filter(|index| run.blocks.contains(index))?;
            Some(state_of(run.masks_of(index), voxel.map(|v| v.rem_euclid(BLOCK_EDGE))))
        };
        self.runs().find_map(of_run).unwrap_or(VoxelState::Unknown)
    }

    fn index_of(&self, block: [i32; 3]) -> Option<u32> {
        let OccupancyHeader { first_block, n_blocks, .. } = self.header;
        let at = |axis: usize| {
            let offset = u32::try_from(block[axis].checked_sub(first_block[axis])?).ok()?;
            (offset < n_blocks[axis]).then_some(offset)
        };
        Some(at(2)? + n_blocks[2] * (at(1)? + n_blocks[1] * at(0)?))
    }
}
