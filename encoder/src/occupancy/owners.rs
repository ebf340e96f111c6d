//! The cell that stores each block: the one with its means nearest.
//!
//! Cells are boxes around means with gaps between them, and free places lie in the gaps too.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use slag_common::frames::Aabb;
use slag_common::occupancy::{BLOCK_EDGE, Block};

use crate::cells::CellSplit;

/// Edge, in blocks, of the groups that share a list of candidate cells.
const GROUP_BLOCKS: i32 = 16;

/// Assigns each block to the cell whose means' box is nearest to its centre, the first of equals.
pub(super) fn by_cell(blocks: &[Block], split: &CellSplit, lattice: Lattice) -> Vec<Vec<Block>> {
    let mut groups: BTreeMap<[i32; 3], Vec<Block>> = BTreeMap::new();
    for block in blocks {
        groups.entry(block.at.map(|at| at.div_euclid(GROUP_BLOCKS))).or_default().push(*block);
    }
    let groups: Vec<([i32; 3], Vec<Block>)> = groups.into_iter().collect();
    let owners: Vec<Vec<usize>> = groups
        .par_iter()
        .map(|(group, blocks)| {
            let min = lattice.corner(group.map(|at| at * GROUP_BLOCKS));
            let bounds = Aabb { min, max: min + lattice.block() * f64::from(GROUP_BLOCKS) };
            let near = candidates(&bounds, split);
            blocks.iter().map(|block| nearest(&near, split, lattice, block)).collect()
        })
        .collect();
    let mut of_cell = vec![Vec::new(); split.cells.len()];
    for ((_, blocks), owners) in groups.iter().zip(owners) {
        blocks.iter().zip(owners).for_each(|(block, owner)| of_cell[owner].push(*block));
    }
    of_cell
}

/// Cells that may be nearest to a point in a box: no farther from its centre than the nearest cell plus the box's
/// diagonal.
fn candidates(bounds: &Aabb, split: &CellSplit) -> Vec<usize> {
    let distance = |cell: usize| split.cells[cell].mean_bounds.distance_to(bounds.centre());
    let all = 0..split.cells.len();
    let least = all.clone().map(distance).fold(f64::INFINITY, f64::min);
    all.filter(|cell| distance(*cell) <= least + bounds.size().length()).collect()
}

fn nearest(near: &[usize], split: &CellSplit, lattice: Lattice, block: &Block) -> usize {
    let distance = |cell: usize| split.cells[cell].mean_bounds.distance_to(lattice.centre(block.at));
    near.iter()
        .copied()
        .reduce(|best, cell| if distance(cell) < distance(best) { cell } else { best })
        .unwrap_or(0)
}

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

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use slag_math::random::Random;

    use super::*;
    use crate::cells::{Cell, PositionGrid};

    /// Oracle: every cell compared with every block.
    #[test]
    fn a_block_belongs_to_the_nearest_cell() {
        let mut random = Random::new(9);
        let cell = |random: &mut Random| {
            let min = DVec3::from([0; 3].map(|_| random.between(-30.0, 30.0)));
            let bounds = Aabb { min, max: min + DVec3::from([0; 3].map(|_| random.between(0.0, 9.0))) };
            Cell { gaussians: Vec::new(), mean_bounds: bounds, bounds, grid: PositionGrid::default() }
        };
        let cells: Vec<Cell> = (0..40).map(|_| cell(&mut random)).collect();
        let split = CellSplit { cells, ..CellSplit::default() };
        let lattice = Lattice { voxel: 0.1 };
        let blocks: Vec<Block> = (0..2000)
            .map(|_| Block { at: [0; 3].map(|_| random.between(-120.0, 120.0) as i32), occupied: 1, free: 0 })
            .collect();
        let of_cell = by_cell(&blocks, &split, lattice);
        assert_eq!(of_cell.iter().map(Vec::len).sum::<usize>(), blocks.len());
        for (cell, block) in
            of_cell.iter().enumerate().flat_map(|(cell, blocks)| blocks.iter().map(move |b| (cell, b)))
        {
            let centre = (DVec3::from(block.at.map(f64::from)) + 0.5) * 0.4;
            let distance = |cell: &Cell| cell.mean_bounds.distance_to(centre);
            let least = split.cells.iter().map(distance).fold(f64::INFINITY, f64::min);
            let first = split.cells.iter().position(|cell| distance(cell) == least);
            assert_eq!(Some(cell), first, "{block:?}");
        }
    }
}
