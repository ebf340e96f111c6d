//! Makes the columns of a shard's occupancy.

use super::columns::{KIND_BITS, Occupancy, OccupancyHeader, RunKind, StoredRun};

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

/// The occupancy of a shard, to be written.
#[derive(Clone, Debug, PartialEq)]
pub struct BuiltOccupancy {
    header: OccupancyHeader,
    runs: Vec<StoredRun>,
    masks: Vec<[u64; 2]>,
}

impl BuiltOccupancy {
    /// Packs blocks, in any order, each at most once. Blocks without a known voxel are left out; so are those more
    /// than 256 blocks from the median block along an axis, which stray Gaussians make: a robot takes both as
    /// unknown.
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

    /// Returns the columns as readers see them.
    pub fn view(&self) -> Occupancy<'_> {
        Occupancy { header: self.header, runs: &self.runs, masks: &self.masks }
    }

    /// Returns the bytes that the columns take.
    pub fn len_bytes(&self) -> u64 {
        self.view().sections().iter().map(|(_, bytes)| bytes.len() as u64).sum()
    }
}
