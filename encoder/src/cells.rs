//! The adaptive split of a scene into cells.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::frames::Aabb;

use crate::memory::{MemoryPlan, Phase};

/// Marks a Gaussian that no cell holds in [`CellSplit::cell_of_gaussian`].
pub const NO_CELL: u32 = u32::MAX;

/// Extent of a Gaussian in standard deviations: 99.7 % of its mass along an axis, and a tenth less than the 3.33 at which a
/// rasteriser drops an opaque one.
const EXTENT_SIGMAS: f64 = 3.0;

/// A cell with fewer Gaussians is not cut for its width alone: otherwise each stray Gaussian far from the scene would
/// become a cell.
const MIN_GAUSSIANS_TO_NARROW: usize = 512;

/// Limits of a cell's size.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CellLimits {
    /// Most Gaussians of a cell.
    pub max_gaussians: usize,
    /// Longest edge of the box around a cell's means, world units; `None` where units are not metres.
    pub max_width: Option<f64>,
}

/// A piece of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Its Gaussians: indices in the input, along a Morton curve.
    pub gaussians: Vec<u32>,
    /// Box around the means.
    pub mean_bounds: Aabb,
    /// Box around the extents.
    pub bounds: Aabb,
}

/// The partition of a scene into cells.
#[derive(Clone, Debug, PartialEq)]
pub struct CellSplit {
    /// The cells; a cell's id is its index.
    pub cells: Vec<Cell>,
    /// `[N]`: the cell of each Gaussian of the input, or [`NO_CELL`] where it is unusable.
    pub cell_of_gaussian: Vec<u32>,
    /// `[N]`: its index within [`Cell::gaussians`].
    pub local_of_gaussian: Vec<u32>,
    /// Unusable Gaussians.
    pub n_rejected: usize,
}

impl CellSplit {
    /// Reserves the partition: each Gaussian's cell, its index there, and its place in the cell's list.
    pub fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
        memory.reserve_held(
            Phase::Always,
            "the cell of each Gaussian",
            (n_gaussians * 3 * size_of::<u32>()) as u64,
        );
    }
}

/// Gaussians from which the halves of a box are worth a thread each.
const MIN_GAUSSIANS_TO_SHARE: usize = 1 << 13;

/// Splits a scene: a box with too many Gaussians is cut at the median of its longest axis, a box that is too wide in the
/// middle of it. The result depends only on the Gaussians and the limits.
pub fn split(scene: &Gaussians, limits: CellLimits) -> CellSplit {
    let indices = (0..scene.len() as u32).into_par_iter();
    let mut indices: Vec<u32> = indices.filter(|i| scene.is_usable(*i as usize)).collect();
    let n_rejected = scene.len() - indices.len();
    let cells = split_part(scene, &mut indices, limits);
    let mut cell_of_gaussian = vec![NO_CELL; scene.len()];
    let mut local_of_gaussian = vec![0; scene.len()];
    for (cell_id, cell) in cells.iter().enumerate() {
        for (local, gaussian) in cell.gaussians.iter().enumerate() {
            cell_of_gaussian[*gaussian as usize] = cell_id as u32;
            local_of_gaussian[*gaussian as usize] = local as u32;
        }
    }
    CellSplit { cells, cell_of_gaussian, local_of_gaussian, n_rejected }
}

/// Returns the cells of a part, those of its lower half first.
fn split_part(scene: &Gaussians, part: &mut [u32], limits: CellLimits) -> Vec<Cell> {
    if part.is_empty() {
        return Vec::new();
    }
    let mean_bounds = bounds_of_means(scene, part);
    let size = mean_bounds.size();
    let axis = (0..3).max_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(0);
    let coordinate = |i: &u32| scene.means_in_world[*i as usize][axis];
    let too_wide =
        limits.max_width.is_some_and(|max| size[axis] > max) && part.len() > MIN_GAUSSIANS_TO_NARROW;
    let cut = if part.len() > limits.max_gaussians.max(1) {
        let middle = part.len() / 2;
        // Ties are broken by index: the halves are the same sets every time.
        part.select_nth_unstable_by(middle, |a, b| coordinate(a).total_cmp(&coordinate(b)).then(a.cmp(b)));
        middle
    } else if too_wide {
        let plane = mean_bounds.centre()[axis];
        part.sort_unstable_by(|a, b| coordinate(a).total_cmp(&coordinate(b)).then(a.cmp(b)));
        part.partition_point(|i| coordinate(i) < plane)
    } else {
        return vec![finish(scene, part, mean_bounds)];
    };
    let is_shared = part.len() >= MIN_GAUSSIANS_TO_SHARE;
    let (low, high) = part.split_at_mut(cut);
    let (of_low, of_high) = (|| split_part(scene, low, limits), || split_part(scene, high, limits));
    let (mut cells, high) = if is_shared { rayon::join(of_low, of_high) } else { serially(of_low, of_high) };
    cells.extend(high);
    cells
}

fn serially<A, B>(a: impl FnOnce() -> A, b: impl FnOnce() -> B) -> (A, B) {
    (a(), b())
}

fn bounds_of_means(scene: &Gaussians, part: &[u32]) -> Aabb {
    let mut bounds = Aabb::EMPTY;
    part.iter().for_each(|i| bounds.extend_ball(scene.means_in_world[*i as usize], 0.0));
    bounds
}

fn finish(scene: &Gaussians, part: &[u32], mean_bounds: Aabb) -> Cell {
    let mut keyed: Vec<(u64, u32)> =
        part.iter().map(|i| (morton(scene.means_in_world[*i as usize], &mean_bounds), *i)).collect();
    keyed.sort_unstable();
    let mut bounds = mean_bounds;
    for i in part {
        let half = extent(scene, *i as usize);
        let mean = scene.means_in_world[*i as usize];
        bounds.min = bounds.min.min(mean - half);
        bounds.max = bounds.max.max(mean + half);
    }
    Cell { gaussians: keyed.into_iter().map(|(_, i)| i).collect(), mean_bounds, bounds }
}

/// Returns a Gaussian's extent along each world axis: `EXTENT_SIGMAS * sqrt(diag(R S² Rᵀ))`.
fn extent(scene: &Gaussians, index: usize) -> DVec3 {
    let [w, x, y, z] = scene.rotations_wxyz[index].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = DVec3::from(scene.scales[index].map(f64::from));
    let axis = |a: usize| (rotation.row(a) * scales).length() * EXTENT_SIGMAS;
    DVec3::new(axis(0), axis(1), axis(2))
}

/// Returns the place along a Morton (Z-order) curve of 2^21 steps per axis.
fn morton(position: DVec3, bounds: &Aabb) -> u64 {
    let step = (bounds.size() / f64::from((1 << 21) - 1)).max(DVec3::splat(f64::MIN_POSITIVE));
    let q = (position - bounds.min) / step;
    spread_bits(q.x as u64) | spread_bits(q.y as u64) << 1 | spread_bits(q.z as u64) << 2
}

/// Spreads the low 21 bits to every third place.
fn spread_bits(value: u64) -> u64 {
    let mut v = value & 0x1f_ffff;
    v = (v | v << 32) & 0x001f_0000_0000_ffff;
    v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn scene(means: &[[f64; 3]], scale: f32) -> Gaussians {
        let n = means.len();
        Gaussians {
            means_in_world: means.iter().map(|m| DVec3::from(*m)).collect(),
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[scale, 2.0 * scale, 0.0]; n],
            opacities: vec![0.5; n],
            sh_dc: vec![[0.0; 3]; n],
            sh_rest: Vec::new(),
            sh_degree: 0,
        }
    }

    proptest! {
        #[test]
        fn every_usable_gaussian_lies_in_one_cell_within_the_limits(
            mut means in prop::collection::vec(prop::array::uniform3(-100.0..100.0f64), 1..2000),
            max_gaussians in 1usize..300, max_width in 5.0..50.0f64, repeat in 0usize..400,
        ) {
            let first = means[0];
            means.extend(std::iter::repeat_n(first, repeat));
            means.push([f64::NAN, 0.0, 0.0]);
            let scene = scene(&means, 0.5);
            let result = split(&scene, CellLimits { max_gaussians, max_width: Some(max_width) });
            prop_assert_eq!(result.n_rejected, 1);
            let mut seen = vec![0; means.len()];
            for (id, cell) in result.cells.iter().enumerate() {
                prop_assert!(cell.gaussians.len() <= max_gaussians);
                let narrow = cell.mean_bounds.size().max_element() <= max_width;
                prop_assert!(narrow || cell.gaussians.len() <= MIN_GAUSSIANS_TO_NARROW);
                for (local, g) in cell.gaussians.iter().enumerate() {
                    seen[*g as usize] += 1;
                    prop_assert_eq!(result.cell_of_gaussian[*g as usize], id as u32);
                    prop_assert_eq!(result.local_of_gaussian[*g as usize], local as u32);
                    let mean = scene.means_in_world[*g as usize];
                    let half = DVec3::new(1.5, 3.0, 0.0);
                    prop_assert!((mean - half).cmpge(cell.bounds.min - 1e-6).all() && (mean + half).cmple(cell.bounds.max + 1e-6).all());
                }
            }
            prop_assert!(seen[..means.len() - 1].iter().all(|n| *n == 1));
            prop_assert_eq!(result.cell_of_gaussian[means.len() - 1], NO_CELL);
        }
    }

    #[test]
    fn morton_interleaves_bits() {
        assert_eq!(spread_bits(0b1011), 0b1_000_001_001);
        assert_eq!(spread_bits((1 << 21) - 1).count_ones(), 21);
    }
}
