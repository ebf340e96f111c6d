//! The columns of a shard's occupancy.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::container::{self, ContainerError, Layout, damaged};

/// Voxels along an edge of a block.
pub const BLOCK_EDGE: i32 = 4;
/// Bits of a stored run that name its kind.
pub(super) const KIND_BITS: u32 = 2;

pub mod section {
    /// [`super::OccupancyHeader`].
    pub const HEADER: u32 = 50;
    /// `[n_runs]` [`super::StoredRun`].
    pub const RUNS: u32 = 51;
    /// `[n_mixed][2]` u64: occupied voxels and free voxels of each mixed block, in the order of the runs.
    pub const MASKS: u32 = 52;
}

#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct OccupancyHeader {
    /// Edge of a voxel, world units.
    pub voxel: f64,
    /// Smallest block along each axis: block b begins at voxel 4 b.
    pub first_block: [i32; 3],
    pub n_blocks: [u32; 3],
    pub n_runs: u32,
    /// Blocks with masks of their own.
    pub n_mixed: u32,
    /// Opacity from which a voxel is occupied.
    pub min_opacity: f32,
    /// Views that must have looked through a free voxel, at least.
    pub min_views: u32,
}

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
    /// Returns the occupancy in a shard's checked bytes.
    pub(crate) fn of(bytes: &'a [u8], layout: &Layout) -> Option<Self> {
        let header = bytemuck::pod_read_unaligned(&bytes[layout.find(section::HEADER)?]);
        let (runs, masks) = (layout.slice(bytes, section::RUNS), layout.slice(bytes, section::MASKS));
        Some(Self { header, runs, masks })
    }

    /// Returns the sections, to be written after the shard's own.
    pub fn sections(&self) -> [(u32, &[u8]); 3] {
        [
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::RUNS, container::bytes_of(self.runs)),
            (section::MASKS, container::bytes_of(self.masks)),
        ]
    }

    /// Returns the runs of blocks, ascending. Clip a run to the wanted blocks before iterating: it may be very long.
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

    pub fn block_at(&self, index: u32) -> [i32; 3] {
        let [_, n_y, n_z] = self.header.n_blocks;
        let (x, y, z) = (index / n_z / n_y, index / n_z % n_y, index % n_z);
        let first = self.header.first_block;
        [first[0] + x as i32, first[1] + y as i32, first[2] + z as i32]
    }
}

/// Most blocks of a shard's box: readers count them in 32 bits, and a writer keeps within 512 along each axis.
const MAX_BLOCKS: u64 = 1 << 27;
/// Farthest block from the world's origin: voxels are numbered in 32 bits.
const MAX_BLOCK: i64 = 1 << 28;
const MAX_VOXEL: f64 = 1e6;

/// Checks the occupancy of a shard, if it has any.
pub(crate) fn check(bytes: &[u8], layout: &Layout) -> Result<(), ContainerError> {
    let Some(at_header) = layout.find(section::HEADER) else { return Ok(()) };
    let header: OccupancyHeader = layout.value(bytes, section::HEADER, "header of the occupancy")?;
    check_header(&header).map_err(|what| damaged(at_header.start, what))?;
    let runs = layout.column::<StoredRun>(section::RUNS, "runs of blocks", header.n_runs as usize)?;
    let masks = layout.column::<[u64; 2]>(section::MASKS, "masks of blocks", header.n_mixed as usize)?;
    let n_blocks: u32 = header.n_blocks.iter().product();
    let (mut end, mut n_mixed) = (0u32, 0u64);
    let stored: Vec<StoredRun> = bytemuck::pod_collect_to_vec(&bytes[runs.clone()]);
    for (at, run) in stored.iter().enumerate() {
        let stop = run.start.checked_add(run.len()).filter(|stop| *stop <= n_blocks);
        let (true, true, Some(stop), Some(kind)) = (run.start >= end, run.len() > 0, stop, run.kind()) else {
            let what = format!(
                "run {at} of blocks begins at {} and has {} of kind {}, expected a begin of at least {end}, an end of at most {n_blocks} and kind 1 to 3",
                run.start,
                run.len(),
                run.len_and_kind & 3
            );
            return Err(damaged(runs.start + at * size_of::<StoredRun>(), what));
        };
        end = stop;
        n_mixed += if kind == RunKind::Mixed { u64::from(run.len()) } else { 0 };
    }
    if n_mixed != u64::from(header.n_mixed) {
        let what = format!("{n_mixed} mixed blocks in the runs, the header has {}", header.n_mixed);
        return Err(damaged(at_header.start, what));
    }
    for (at, pair) in bytes[masks.clone()].chunks_exact(16).enumerate() {
        if (0..8).any(|byte| pair[byte] & pair[8 + byte] != 0) {
            let what = format!("a voxel of mixed block {at} is free and occupied");
            return Err(damaged(masks.start + at * 16, what));
        }
    }
    Ok(())
}

fn check_header(header: &OccupancyHeader) -> Result<(), String> {
    let OccupancyHeader { voxel, first_block, n_blocks, min_opacity, .. } = *header;
    if !(voxel > 0.0 && voxel <= MAX_VOXEL) {
        return Err(format!("voxels of {voxel}, expected above 0 and at most {MAX_VOXEL}"));
    }
    let product = n_blocks.iter().fold(1u64, |product, n| product.saturating_mul(u64::from(*n)));
    let is_near = (0..3).all(|axis| {
        let (first, n) = (i64::from(first_block[axis]), i64::from(n_blocks[axis]));
        n > 0 && first >= -MAX_BLOCK && first + n <= MAX_BLOCK
    });
    if product > MAX_BLOCKS || !is_near {
        return Err(format!(
            "{n_blocks:?} blocks from {first_block:?}, expected 1 to {MAX_BLOCKS} in all, within {MAX_BLOCK} of the origin"
        ));
    }
    if !(0.0..=1.0).contains(&min_opacity) {
        return Err(format!("a least opacity of {min_opacity}, expected 0 to 1"));
    }
    Ok(())
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Block {
    /// Its place on the scene's lattice.
    pub at: [i32; 3],
    /// Occupied voxels; the order of bits is that of [`Occupancy::masks`].
    pub occupied: u64,
    /// Free voxels, none of them occupied.
    pub free: u64,
}

/// Most blocks along an axis of a shard: the box of all blocks stays within the format's limit.
const MAX_EDGE: i32 = 512;

#[derive(Clone, Debug, PartialEq)]
pub struct BuiltOccupancy {
    header: OccupancyHeader,
    runs: Vec<StoredRun>,
    masks: Vec<[u64; 2]>,
}

impl BuiltOccupancy {
    /// Packs blocks, in any order, each at most once. Drops blocks without a known voxel and, as strays, those
    /// more than 256 blocks from the median along an axis; robots treat both as unknown.
    pub fn pack(voxel: f64, min_opacity: f32, min_views: u32, blocks: &[Block]) -> Self {
        let mut known: Vec<Block> = blocks.iter().copied().filter(|b| b.occupied | b.free != 0).collect();
        for axis in 0..3 {
            let mut places: Vec<i32> = known.iter().map(|block| block.at[axis]).collect();
            places.sort_unstable();
            let Some(median) = places.get(places.len() / 2).copied() else { break };
            let (low, high) = (median - MAX_EDGE / 2, median + MAX_EDGE / 2);
            known.retain(|block| (low..high).contains(&block.at[axis]));
        }
        let corner = |pick: fn(i32, i32) -> i32| {
            known.iter().map(|block| block.at).reduce(|a, b| [0, 1, 2].map(|axis| pick(a[axis], b[axis])))
        };
        let first_block = corner(i32::min).unwrap_or_default();
        let last = corner(i32::max).unwrap_or_default();
        let n_blocks = [0, 1, 2].map(|axis| (last[axis] - first_block[axis] + 1) as u32);
        let index = |block: &Block| {
            let [x, y, z] = [0, 1, 2].map(|axis| (block.at[axis] - first_block[axis]) as u32);
            z + n_blocks[2] * (y + n_blocks[1] * x)
        };
        known.sort_unstable_by_key(index);
        let (mut runs, mut masks) = (Vec::<StoredRun>::new(), Vec::new());
        for block in &known {
            let kind = match (block.occupied, block.free) {
                (0, u64::MAX) => RunKind::Free,
                (u64::MAX, 0) => RunKind::Occupied,
                _ => RunKind::Mixed,
            };
            if kind == RunKind::Mixed {
                masks.push([block.occupied, block.free]);
            }
            let start = index(block);
            match runs.last_mut() {
                Some(run) if run.start + run.len() == start && run.kind() == Some(kind) => {
                    run.len_and_kind += 1 << KIND_BITS;
                }
                _ => runs.push(StoredRun { start, len_and_kind: 1 << KIND_BITS | kind as u32 }),
            }
        }
        let (n_runs, n_mixed) = (runs.len() as u32, masks.len() as u32);
        let header =
            OccupancyHeader { voxel, first_block, n_blocks, n_runs, n_mixed, min_opacity, min_views };
        Self { header, runs, masks }
    }

    pub fn view(&self) -> Occupancy<'_> {
        Occupancy { header: self.header, runs: &self.runs, masks: &self.masks }
    }

    pub fn len_bytes(&self) -> u64 {
        self.view().sections().iter().map(|(_, bytes)| bytes.len() as u64).sum()
    }
}
