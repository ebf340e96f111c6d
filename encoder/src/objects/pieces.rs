//! Small pieces of surface belong to one object as a whole: masks are ragged, and leak over borders that colour and shape show.

use rayon::prelude::*;

use crate::cells::CellSplit;
use crate::lift::superpoint::Superpoints;
use crate::memory::{MemoryPlan, Phase};

/// Reserves the list that [`settle`] sorts.
pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    let len_bytes = n_gaussians * size_of::<(u32, u32)>();
    memory.reserve_expecting(Phase::Objects, "objects of superpoints", len_bytes as u64, 0);
}

/// Gives the Gaussians of each superpoint the object that most of them have, or none; of equally many the first object.
///
/// `object_of`: `[cell][N of the cell]`: the object of each Gaussian, or [`NONE`](super::NONE).
pub fn settle(object_of: &mut [Vec<u32>], split: &CellSplit, superpoints: &Superpoints) {
    let labels = split.cells.par_iter().zip(&*object_of);
    let labels =
        labels.flat_map_iter(|(cell, of_cell)| cell.gaussians.iter().copied().zip(of_cell.iter().copied()));
    let chosen = superpoints.most_frequent(labels);
    split.cells.par_iter().zip(object_of).for_each(|(cell, of_cell)| {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell) {
            let superpoint = superpoints.of_gaussian[*gaussian as usize];
            if let Some(Some(of_superpoint)) = chosen.get(superpoint as usize) {
                *object = *of_superpoint;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use slag_common::frames::Aabb;

    use super::*;
    use crate::cells::Cell;
    use crate::lift::superpoint::NO_SUPERPOINT;
    use crate::objects::NONE;

    /// Two cells of 50 Gaussians. By hand: of superpoint 0, which crosses the border, 40 of 60 are object 0; of superpoint 1 most
    /// are none; superpoint 2 is half object 0 and half none; the last Gaussian has no superpoint. Object 1 is a part of superpoint 0.
    #[test]
    fn a_superpoint_is_of_one_object_or_none() {
        let nowhere = Aabb { min: DVec3::ZERO, max: DVec3::ZERO };
        let cell = |from: u32| Cell {
            gaussians: (from..from + 50).collect(),
            mean_bounds: nowhere,
            bounds: nowhere,
        };
        let (cell_of_gaussian, local_of_gaussian) = (0..100).map(|i| (i / 50, i % 50)).unzip();
        let split =
            CellSplit { cells: vec![cell(0), cell(50)], cell_of_gaussian, local_of_gaussian, n_rejected: 0 };
        let superpoint = |i: usize| match i {
            0..60 => 0,
            60..89 => 1,
            89..99 => 2,
            _ => NO_SUPERPOINT,
        };
        let before = |i: usize| match i {
            0..40 | 60..70 | 89..94 | 99 => 0,
            40..43 => 1,
            _ => NONE,
        };
        let after = |i: usize| match i {
            0..60 | 89..100 => 0,
            _ => NONE,
        };
        let by_cell = |object: &dyn Fn(usize) -> u32| -> Vec<Vec<u32>> {
            [0..50, 50..100].map(|range| range.map(object).collect()).into()
        };
        let superpoints = Superpoints { of_gaussian: (0..100).map(superpoint).collect(), n: 3 };
        let mut object_of = by_cell(&before);
        settle(&mut object_of, &split, &superpoints);
        assert_eq!(object_of, by_cell(&after));
    }
}
