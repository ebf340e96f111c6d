//! The adaptive split of a scene into cells, and the grid to which each cell's positions are rounded.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::frames::Aabb;
use slag_common::shard::PositionForm;
use slag_math::stats::{Rank, quantile};

use crate::memory::{MemoryPlan, Phase};

/// Marks a Gaussian that no cell holds in [`CellSplit::cell_of_gaussian`].
pub(crate) const NO_CELL: u32 = u32::MAX;

/// Extent of a Gaussian in standard deviations: 99.7 % of its mass along an axis, and a tenth less than the 3.33
/// at which a rasteriser drops an opaque one.
const EXTENT_SIGMAS: f64 = 3.0;

/// Cells with fewer Gaussians are not cut for width alone: each stray would become a cell.
const MIN_GAUSSIANS_TO_NARROW: usize = 512;

/// A cell holds other things, such as a sky around a chair, where its 10th percentile is this many times that of its
/// 512th Gaussian. In ordinary cells it is up to 3 times.
const OTHER_SIZE: f32 = 8.0;

/// A Gaussian is a stray if larger than its cell and than this many times the 99th percentile of sizes. It counts with
/// the latter in the cell's box: otherwise a few huge ones would bring every robot every cell.
const STRAY_EXTENT: f64 = 3.0;

/// Most cells of a scene: the manifest, which lists them, then has a quarter of the bytes that robots accept.
pub(crate) const MAX_CELLS: usize = 65_536;

/// Most cells that are cut only for exact positions; more means that the error is finer than the scene's coordinates.
/// Each cell is a file of some kilobytes.
pub(crate) const MAX_CELLS_FOR_PRECISION: usize = 4096;

/// Largest error of a position, per axis.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum PositionError {
    /// World units.
    Within(f64),
    /// A quarter of the size of a cell's small Gaussians: the 10th percentile of the largest scales or, where that is
    /// the size of other things, as of a sky, that of the 512th Gaussian.
    OfSize,
}

impl PositionError {
    /// Returns one centimetre for a metric model, else the size of the Gaussians.
    pub(crate) fn default_for(metric: bool) -> Self {
        if metric { Self::Within(0.01) } else { Self::OfSize }
    }

    fn of_part(self, scene: &Gaussians, part: &[u32]) -> f64 {
        if let Self::Within(error) = self {
            return error;
        }
        let largest = |g: &u32| scene.scales[*g as usize].into_iter().fold(0.0, f32::max);
        let size = f64::from(of_small(part.iter().map(largest).collect())) / 4.0;
        // Never finer than 32-bit input is at the nearest Gaussians; strays do not count.
        let farthest = |g: &u32| scene.means_in_world[*g as usize].abs().max_element() as f32;
        let place = f64::from(of_small(part.iter().map(farthest).collect()));
        size.max(place * f64::from(f32::EPSILON) / 2.0)
    }
}

/// Returns the 10th percentile, or the 512th positive value where that is far smaller: a tenth of a few thousand
/// Gaussians may be a hundredth of as many of another kind. 0 without values.
fn of_small(mut values: Vec<f32>) -> f32 {
    let Some(tenth) = quantile(&mut values, 100, Rank::After) else { return 0.0 };
    values.retain(|value| *value > 0.0);
    if values.len() <= MIN_GAUSSIANS_TO_NARROW {
        return tenth;
    }
    let few = *values.select_nth_unstable_by(MIN_GAUSSIANS_TO_NARROW, f32::total_cmp).1;
    if few * OTHER_SIZE < tenth { few } else { tenth }
}

#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CellLimits {
    pub max_gaussians: usize,
    /// Longest edge of the box around a cell's means, world units; `None` where units are not metres.
    pub max_width: Option<f64>,
    /// A cell is so small that its positions keep this error.
    pub position_error: PositionError,
}

impl CellLimits {
    /// Limits the number of Gaussians, not the width.
    pub fn by_count(max_gaussians: usize) -> Self {
        Self { max_gaussians, max_width: None, position_error: PositionError::OfSize }
    }
}

/// The grid to which a cell's positions are rounded: multiples of `step` from the smallest corner of the means' box.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PositionGrid {
    /// World units; 0 along a flat axis.
    pub step: [f64; 3],
    /// Bits per axis, then 0.
    pub bits: [u8; 4],
}

impl PositionGrid {
    /// Finds the smallest grid over a box with a place within `error` of every point; `None` if there is none.
    fn within(bounds: &Aabb, error: f64) -> Option<Self> {
        let size = bounds.size().to_array();
        // Decoded positions are rounded to doubles.
        let rounding = bounds.min.abs().max(bounds.max.abs()).max_element() * f64::EPSILON;
        let uniform = |bits: u8| [bits; 3];
        let forms = packed_bits(size).into_iter().chain([uniform(16), uniform(32)]);
        let mut grids = forms.map(|bits| Self::new(size, bits));
        grids.find(|grid| {
            (0..3).all(|axis| {
                size[axis] <= 0.0 || grid.bits[axis] > 0 && grid.step[axis] / 2.0 + rounding <= error
            })
        })
    }

    fn new(size: [f64; 3], bits: [u8; 3]) -> Self {
        let step =
            std::array::from_fn(|axis| if bits[axis] > 0 { step(size[axis], bits[axis]) } else { 0.0 });
        Self { step, bits: [bits[0], bits[1], bits[2], 0] }
    }
}

fn step(size: f64, bits: u8) -> f64 {
    size / ((1u64 << bits) - 1).max(1) as f64
}

/// Distributes 32 bits over the axes for the finest coarsest step; `None` for the bits that mark another form.
fn packed_bits(size: [f64; 3]) -> Option<[u8; 3]> {
    let mut bits = [0u8; 3];
    loop {
        // Each bit goes to the coarsest axis.
        let coarseness =
            |axis: usize| if bits[axis] == 0 { 2.0 * size[axis] } else { step(size[axis], bits[axis]) };
        let axis = (0..3).max_by(|a, b| coarseness(*a).total_cmp(&coarseness(*b)))?;
        let n_bits: u8 = bits.iter().sum();
        if n_bits == 32 || size[axis] <= 0.0 || bits[axis] == 31 {
            break;
        }
        bits[axis] += 1;
    }
    (bits != [16; 3]).then_some(bits)
}

#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Indices in the input, along a Morton curve.
    pub gaussians: Vec<u32>,
    pub(crate) mean_bounds: Aabb,
    /// Box around the extents, but see [`STRAY_EXTENT`].
    pub bounds: Aabb,
    pub grid: PositionGrid,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellSplit {
    /// A cell's id is its index.
    pub cells: Vec<Cell>,
    /// `[N]`: cell of each input Gaussian; [`NO_CELL`] where it is unusable.
    pub(crate) cell_of_gaussian: Vec<u32>,
    /// `[N]`: index within [`Cell::gaussians`].
    pub local_of_gaussian: Vec<u32>,
    /// Unusable Gaussians.
    pub n_rejected: usize,
    /// Cells that are smaller than count and width require, for exact positions.
    pub(crate) n_for_precision: usize,
}

impl CellSplit {
    /// The limits that decided the split; equal ones cut a scene equally.
    pub(crate) fn deciding(&self, limits: CellLimits) -> (usize, Option<f64>, Option<PositionError>) {
        let precision = (self.n_for_precision > 0).then_some(limits.position_error);
        (limits.max_gaussians, limits.max_width, precision)
    }

    /// Cell of the Gaussian mean nearest to a point; ties go to the first cell.
    pub(crate) fn nearest(&self, point: DVec3) -> Option<usize> {
        let distances = self.cells.iter().map(|cell| cell.mean_bounds.distance_to(point)).enumerate();
        distances.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(cell, _)| cell)
    }

    /// Reserves the partition: each Gaussian's cell, its index there, and its entry in the cell's list.
    pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
        let len_bytes = (n_gaussians * 3 * size_of::<u32>()) as u64;
        memory.reserve(Phase::Always, "the cell of each Gaussian", len_bytes);
    }
}

/// From this many Gaussians on, the halves of a box are worth a thread each.
const MIN_GAUSSIANS_TO_SHARE: usize = 1 << 13;

/// Splits a scene. A box with too many Gaussians is cut at the median of its longest axis; a box too wide, or too wide
/// for exact positions, in the middle. The result depends only on the Gaussians and the limits.
pub fn split(scene: &Gaussians, limits: CellLimits) -> CellSplit {
    let indices = (0..scene.len() as u32).into_par_iter();
    let mut indices: Vec<u32> = indices.filter(|i| scene.is_usable(*i as usize)).collect();
    let n_rejected = scene.len() - indices.len();
    let (cells, for_precision): (Vec<Cell>, Vec<bool>) =
        Splitter { scene, limits }.split(&mut indices, false).into_iter().unzip();
    let mut cell_of_gaussian = vec![NO_CELL; scene.len()];
    let mut local_of_gaussian = vec![0; scene.len()];
    for (cell_id, cell) in cells.iter().enumerate() {
        for (local, gaussian) in cell.gaussians.iter().enumerate() {
            cell_of_gaussian[*gaussian as usize] = cell_id as u32;
            local_of_gaussian[*gaussian as usize] = local as u32;
        }
    }
    let n_for_precision = for_precision.into_iter().filter(|is| *is).count();
    CellSplit { cells, cell_of_gaussian, local_of_gaussian, n_rejected, n_for_precision }
}

enum Next {
    /// Cut before this many Gaussians of the sorted part; `for_precision`: only exact positions require it.
    Cut {
        at: usize,
        for_precision: bool,
    },
    Keep(PositionGrid),
}

#[derive(Clone, Copy)]
struct Splitter<'a> {
    scene: &'a Gaussians,
    limits: CellLimits,
}

impl Splitter<'_> {
    /// Cells of a part, lower half first, and whether precision made each.
    fn split(self, part: &mut [u32], for_precision: bool) -> Vec<(Cell, bool)> {
        if part.is_empty() {
            return Vec::new();
        }
        let mean_bounds = bounds_of_means(self.scene, part);
        let (at, for_precision) = match self.next(part, &mean_bounds) {
            Next::Keep(grid) => return vec![(finish(self.scene, part, mean_bounds, grid), for_precision)],
            Next::Cut { at, for_precision: now } => (at, for_precision || now),
        };
        let is_shared = part.len() >= MIN_GAUSSIANS_TO_SHARE;
        let (low, high) = part.split_at_mut(at);
        let (mut low, mut high) = (|| self.split(low, for_precision), || self.split(high, for_precision));
        let (mut cells, high) = if is_shared { rayon::join(low, high) } else { (low(), high()) };
        cells.extend(high);
        cells
    }

    fn next(self, part: &mut [u32], mean_bounds: &Aabb) -> Next {
        let Self { scene, limits } = self;
        let size = mean_bounds.size();
        let axis = (0..3).max_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(0);
        let coordinate = |i: &u32| scene.means_in_world[*i as usize][axis];
        // Ties are broken by index, so the halves are always the same.
        let order = |a: &u32, b: &u32| coordinate(a).total_cmp(&coordinate(b)).then(a.cmp(b));
        if part.len() > limits.max_gaussians.max(1) {
            let middle = part.len() / 2;
            part.select_nth_unstable_by(middle, order);
            return Next::Cut { at: middle, for_precision: false };
        }
        let is_wide = limits.max_width.is_some_and(|max| size[axis] > max);
        let narrows = is_wide && part.len() > MIN_GAUSSIANS_TO_NARROW;
        let error = limits.position_error.of_part(scene, part);
        let grid = if narrows { None } else { PositionGrid::within(mean_bounds, error) };
        if let Some(grid) = grid
            && PositionForm::of(grid.bits) != PositionForm::Full
        {
            return Next::Keep(grid);
        }
        part.sort_unstable_by(order);
        if let Some(grid) = grid {
            // The full form doubles the bits for all; strays beyond a gap are cut off instead.
            let gap = |k: &usize| coordinate(&part[*k]) - coordinate(&part[*k - 1]) > size[axis] / 2.0;
            let at = (1..part.len()).find(gap);
            return at.map_or(Next::Keep(grid), |at| Next::Cut { at, for_precision: true });
        }
        let plane = mean_bounds.centre()[axis];
        let at = match part.partition_point(|i| coordinate(i) < plane) {
            // The next larger coordinate is the plane's, rounded: a cut is there in any case.
            0 => part.partition_point(|i| coordinate(i) <= mean_bounds.min[axis]),
            at => at,
        };
        Next::Cut { at, for_precision: !narrows }
    }
}

fn bounds_of_means(scene: &Gaussians, part: &[u32]) -> Aabb {
    let mut bounds = Aabb::EMPTY;
    part.iter().for_each(|i| bounds.extend_ball(scene.means_in_world[*i as usize], 0.0));
    bounds
}

fn finish(scene: &Gaussians, part: &[u32], mean_bounds: Aabb, grid: PositionGrid) -> Cell {
    let mut keyed: Vec<(u64, u32)> =
        part.iter().map(|i| (morton(scene.means_in_world[*i as usize], &mean_bounds), *i)).collect();
    keyed.sort_unstable();
    let mut bounds = mean_bounds;
    let extents: Vec<DVec3> = part.iter().map(|i| extent(scene, *i as usize)).collect();
    let mut largest: Vec<f64> = extents.iter().map(|half| half.max_element()).collect();
    let usual = quantile(&mut largest, 990, Rank::After).unwrap_or(0.0);
    let most = (STRAY_EXTENT * usual).max(mean_bounds.size().max_element());
    for (i, half) in part.iter().zip(extents) {
        let half = if half.max_element() > most { half.min(DVec3::splat(usual)) } else { half };
        let mean = scene.means_in_world[*i as usize];
        bounds.min = bounds.min.min(mean - half);
        bounds.max = bounds.max.max(mean + half);
    }
    Cell { gaussians: keyed.into_iter().map(|(_, i)| i).collect(), mean_bounds, bounds, grid }
}

/// Extent along each world axis: `EXTENT_SIGMAS * sqrt(diag(R S² Rᵀ))`.
fn extent(scene: &Gaussians, index: usize) -> DVec3 {
    let [w, x, y, z] = scene.rotations_wxyz[index].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = DVec3::from(scene.scales[index].map(f64::from));
    let axis = |a: usize| (rotation.row(a) * scales).length() * EXTENT_SIGMAS;
    DVec3::new(axis(0), axis(1), axis(2))
}

/// Place along a Morton (Z-order) curve of 2^21 steps per axis.
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
mod tests;
