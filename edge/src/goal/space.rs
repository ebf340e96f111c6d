//! The free and occupied places around a robot: the blocks of all shards, in columns.

use std::ops::Range;

use glam::DVec3;
use slag_common::occupancy::{BLOCK_EDGE, BlockRun, Occupancy};

use crate::score::Budget;

/// Most blocks of a column: its voxels are the bits of a `u128`.
pub const COLUMN_BLOCKS: i32 = 32;
/// How far below the robot ground may lie, metres.
const BELOW_M: f64 = 2.5;
/// Largest share of a column below the robot.
const MAX_SHARE_BELOW: f64 = 0.4;
/// Farthest block from the world's origin that shards may store; beyond it all is unknown.
const MAX_BLOCK: f64 = (1u32 << 28) as f64;
/// Most blocks gathered: 190 MB.
const MAX_BLOCKS: usize = 8 << 20;

#[derive(Clone, Copy, Debug, bytemuck::Zeroable)]
pub struct Stacked {
    /// Height in blocks above the window's lower side, below [`COLUMN_BLOCKS`].
    pub z: u8,
    pub occupied: u64,
    pub free: u64,
}

/// The part of the lattice around a robot: columns of blocks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    pub voxel: f64,
    pub first: [i32; 3],
    pub n: [usize; 2],
}

impl Window {
    pub fn around(centre: DVec3, range: f64, voxel: f64) -> Self {
        let block = voxel * f64::from(BLOCK_EDGE);
        let at = |value: f64| (value / block).floor().clamp(-MAX_BLOCK, MAX_BLOCK) as i32;
        let below = BELOW_M.min(MAX_SHARE_BELOW * f64::from(COLUMN_BLOCKS) * block);
        let first = [at(centre.x - range), at(centre.y - range), at(centre.z - below)];
        let n =
            [at(centre.x + range) - first[0] + 1, at(centre.y + range) - first[1] + 1].map(|n| n as usize);
        Self { voxel, first, n }
    }

    pub fn cells(&self) -> [usize; 2] {
        self.n.map(|n| n * BLOCK_EDGE as usize)
    }

    /// Returns the voxel of a point, counted from the window's smallest corner.
    pub(crate) fn voxel_of(&self, point: DVec3) -> [i32; 3] {
        let at = point / self.voxel;
        [0, 1, 2].map(|axis| (at[axis].floor() - f64::from(self.first[axis] * BLOCK_EDGE)) as i32)
    }

    /// Returns the cell, a column of voxels, of a point; cells are numbered `x * n_y + y`.
    pub fn cell_of(&self, point: DVec3) -> Option<usize> {
        let [x, y, _] = self.voxel_of(point);
        let [n_x, n_y] = self.cells();
        let inside = x >= 0 && y >= 0 && (x as usize) < n_x && (y as usize) < n_y;
        inside.then(|| x as usize * n_y + y as usize)
    }

    pub(crate) fn centre_of(&self, cell: usize) -> [f64; 2] {
        let n_y = self.cells()[1];
        let at = |axis: usize, offset: usize| {
            (f64::from(self.first[axis] * BLOCK_EDGE) + offset as f64 + 0.5) * self.voxel
        };
        [at(0, cell / n_y), at(1, cell % n_y)]
    }

    /// Returns the height of the lower side of a voxel, world frame.
    pub(crate) fn height_of(&self, z: i32) -> f64 {
        f64::from(self.first[2] * BLOCK_EDGE + z) * self.voxel
    }
}

pub struct Space {
    pub window: Window,
    /// `[columns + 1]`: start of each column's blocks.
    starts: Vec<u32>,
    /// By column, then by height.
    blocks: Vec<Stacked>,
}

impl Space {
    /// Gathers a window's blocks from the shards' occupancies, skipping those with voxels of another size.
    ///
    /// Returns `None` if there are more than 8 million, or the budget is spent.
    pub fn gather(window: Window, occupancies: &[Occupancy<'_>], budget: &Budget) -> Option<Self> {
        let of_lattice = || occupancies.iter().filter(|of| of.header.voxel == window.voxel);
        let n_columns = window.n[0] * window.n[1];
        let mut starts = vec![0u32; n_columns + 1];
        let mut n_blocks = 0;
        for occupancy in of_lattice() {
            for_columns(occupancy, &window, |column, _, _, blocks| {
                starts[column + 1] += blocks.len() as u32;
                n_blocks += blocks.len();
                n_blocks <= MAX_BLOCKS
            });
        }
        if n_blocks > MAX_BLOCKS || !budget.take(n_blocks * size_of::<Stacked>()) {
            return None;
        }
        (0..n_columns).for_each(|column| starts[column + 1] += starts[column]);
        let mut next = starts.clone();
        let mut blocks = bytemuck::zeroed_vec::<Stacked>(n_blocks);
        for occupancy in of_lattice() {
            for_columns(occupancy, &window, |column, z, run, of_run| {
                let next = &mut next[column];
                for (z, block) in (z..).zip(of_run) {
                    let [occupied, free] = run.masks_of(block);
                    blocks[*next as usize] = Stacked { z, occupied, free };
                    *next += 1;
                }
                true
            });
        }
        for column in starts.windows(2) {
            let of_column = &mut blocks[column[0] as usize..column[1] as usize];
            if !of_column.is_sorted_by_key(|block| block.z) {
                of_column.sort_by_key(|block| block.z);
            }
        }
        Some(Self { window, starts, blocks })
    }

    /// Returns the blocks of a column, from the lowest.
    pub fn column(&self, column: usize) -> &[Stacked] {
        &self.blocks[self.starts[column] as usize..self.starts[column + 1] as usize]
    }

    /// Returns a block's free voxels (seen through, no surface), by the window's corner; none beyond the window.
    pub fn free(&self, [x, y, z]: [i32; 3]) -> u64 {
        let [n_x, n_y] = self.window.n;
        let is_inside = x >= 0 && y >= 0 && (x as usize) < n_x && (y as usize) < n_y;
        if !is_inside || !(0..COLUMN_BLOCKS).contains(&z) {
            return 0;
        }
        let of_column = self.column(x as usize * n_y + y as usize);
        let found = of_column.binary_search_by_key(&(z as u8), |block| block.z);
        found.map_or(0, |at| of_column[at].free)
    }
}

/// Visits the pieces of an occupancy's runs within a window's columns: column, height of the first block, run and
/// blocks. Ends when `visit` returns false. Time is bounded by the window and the number of runs.
fn for_columns<'a>(
    occupancy: &Occupancy<'a>,
    window: &Window,
    mut visit: impl FnMut(usize, u8, &BlockRun<'a>, Range<u32>) -> bool,
) {
    let (first, [_, n_y, n_z]) = (occupancy.header.first_block, occupancy.header.n_blocks);
    // Offsets of the window in the shard's box, clipped to it.
    let clip = |axis: usize, n: i64| {
        let low = i64::from(window.first[axis]) - i64::from(first[axis]);
        let limit = i64::from(occupancy.header.n_blocks[axis]);
        low.clamp(0, limit) as u32..(low + n).clamp(0, limit) as u32
    };
    let [xs, ys] = [0, 1].map(|axis| clip(axis, window.n[axis] as i64));
    let zs = clip(2, i64::from(COLUMN_BLOCKS));
    if xs.is_empty() || ys.is_empty() || zs.is_empty() {
        return;
    }
    for run in occupancy.runs() {
        let mut at = run.blocks.start.max(xs.start * n_y * n_z);
        while at < run.blocks.end {
            let column = at / n_z;
            let (x, y) = (column / n_y, column % n_y);
            if x >= xs.end {
                break;
            }
            if y < ys.start {
                at = (x * n_y + ys.start) * n_z;
                continue;
            }
            if y >= ys.end {
                at = ((x + 1) * n_y + ys.start) * n_z;
                continue;
            }
            let bottom = column * n_z;
            let blocks = at.max(bottom + zs.start)..run.blocks.end.min(bottom + zs.end);
            if !blocks.is_empty() {
                let offset = |axis: usize, of: u32| (first[axis] + of as i32 - window.first[axis]) as usize;
                let z = offset(2, blocks.start - bottom) as u8;
                let place = offset(0, x) * window.n[1] + offset(1, y);
                if !visit(place, z, &run, blocks) {
                    return;
                }
            }
            at = bottom + n_z;
        }
    }
}
