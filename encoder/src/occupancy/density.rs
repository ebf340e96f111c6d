//! Which voxels hold a surface: the opacity of all Gaussians at each voxel, by Beer and Lambert's law.
//!
//! `opacity = 1 - exp(-sum over Gaussians of alpha exp(-d^2 / 2))`, where d is the distance of the voxel's centre from
//! the mean in standard deviations of the Gaussian, widened by [`VOXEL_VARIANCE`] of the voxel's squared edge; d above
//! [`MAX_SIGMAS`] counts nothing.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::occupancy::BLOCK_EDGE;

use super::owners::{BlockAt, Lattice};

/// Opacity from which a voxel is occupied (splat-transform's, for voxels of 5 cm).
pub const MIN_OPACITY: f32 = 0.1;
/// Distance from a mean, in standard deviations, up to which a Gaussian counts.
pub(crate) const MAX_SIGMAS: f64 = 3.0;
/// Variance that widens a Gaussian, in squared edges of a voxel: surfaces are thinner than voxels and would miss
/// centres beside them. With 0.15, a closed opaque surface that touches a voxel's corner, 0.866 edges from its centre,
/// still gives an opacity of 0.16.
pub(crate) const VOXEL_VARIANCE: f64 = 0.15;

/// Blocks along a tile's edge: its sums, 1 MiB, stay in a core's cache.
const TILE_BLOCKS: i32 = 16;
const TILE_EDGE: usize = (TILE_BLOCKS * BLOCK_EDGE) as usize;
/// Most tiles along an axis of a Gaussian: larger ones are sky and other background that no robot drives into.
const MAX_TILES: i32 = 8;
/// Largest standard deviation along the shortest axis of a surface's Gaussian, world units; thicker ones are fog, sky
/// or other background.
const MAX_THICKNESS: f32 = 0.2;

pub(super) struct Occupied {
    /// Voxels of each occupied block, by place.
    pub(super) blocks: Vec<(BlockAt, u64)>,
    /// Left out as background: larger than 8 tiles, or thicker than [`MAX_THICKNESS`].
    pub(super) n_background: usize,
}

/// A Gaussian on the lattice, in voxels.
struct Ellipsoid {
    mean: DVec3,
    /// Inverse of the widened covariance.
    precision: DMat3,
    /// Half edges of the box around the part that counts.
    reach: DVec3,
    opacity: f64,
}

impl Ellipsoid {
    fn new(scene: &Gaussians, index: usize, lattice: Lattice) -> Option<Self> {
        let mean = lattice.in_voxels(scene.means_in_world[index])?;
        if scene.scales[index].into_iter().all(|scale| scale > MAX_THICKNESS) {
            return None;
        }
        let [w, x, y, z] = scene.rotations_wxyz[index].map(f64::from);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let scales = DVec3::from(scene.scales[index].map(f64::from)) / lattice.voxel;
        let axes = rotation * DMat3::from_diagonal(scales);
        let covariance = axes * axes.transpose() + DMat3::from_diagonal(DVec3::splat(VOXEL_VARIANCE));
        let variances = DVec3::new(covariance.x_axis.x, covariance.y_axis.y, covariance.z_axis.z);
        let reach = MAX_SIGMAS * DVec3::new(variances.x.sqrt(), variances.y.sqrt(), variances.z.sqrt());
        let opacity = f64::from(scene.opacities[index]);
        let precision = covariance.inverse();
        (reach.is_finite() && precision.is_finite()).then_some(Self { mean, precision, reach, opacity })
    }

    /// Voxels along an axis with their centres in the box.
    fn voxels(&self, axis: usize) -> RangeInclusive<i64> {
        let (mean, reach) = (self.mean[axis], self.reach[axis]);
        (mean - reach - 0.5).ceil() as i64..=(mean + reach - 0.5).floor() as i64
    }

    /// Tiles along an axis that the box reaches; `None` if they are too many for a thing.
    fn tiles(&self, axis: usize) -> Option<RangeInclusive<i32>> {
        let voxels = self.voxels(axis);
        // A reach beyond 64 bits saturates: the quotients' difference still fits.
        let [first, last] = [*voxels.start(), *voxels.end()].map(|voxel| voxel.div_euclid(TILE_EDGE as i64));
        // The mean is on the lattice, so a narrow box is within 32 bits.
        (last - first < i64::from(MAX_TILES)).then_some(first as i32..=last as i32)
    }

    /// Adds `alpha exp(-d^2 / 2)` to a tile's voxels, row by row along z: a quadratic equation gives the row's ends in
    /// the ellipsoid.
    fn add_to(&self, tile: [i32; 3], sums: &mut [f32]) {
        let first = tile.map(|t| i64::from(t) * TILE_EDGE as i64);
        let clipped = |axis: usize, range: RangeInclusive<i64>| {
            let last = first[axis] + TILE_EDGE as i64 - 1;
            first[axis].max(*range.start())..=last.min(*range.end())
        };
        let p = &self.precision;
        let (a, limit) = (p.z_axis.z, MAX_SIGMAS * MAX_SIGMAS);
        let offset = |axis: usize, voxel: i64| voxel as f64 + 0.5 - self.mean[axis];
        for x in clipped(0, self.voxels(0)) {
            let dx = offset(0, x);
            for y in clipped(1, self.voxels(1)) {
                let dy = offset(1, y);
                let b = p.x_axis.z * dx + p.y_axis.z * dy;
                let c = p.x_axis.x * dx * dx + 2.0 * p.x_axis.y * dx * dy + p.y_axis.y * dy * dy;
                let root = b * b - a * (c - limit);
                if root < 0.0 {
                    continue;
                }
                let at = |sign: f64| (-b + sign * root.sqrt()) / a + self.mean[2] - 0.5;
                let row = ((x - first[0]) as usize * TILE_EDGE + (y - first[1]) as usize) * TILE_EDGE;
                for z in clipped(2, at(-1.0).ceil() as i64..=at(1.0).floor() as i64) {
                    let dz = offset(2, z);
                    let d2 = c + dz * (2.0 * b + a * dz);
                    sums[row + (z - first[2]) as usize] += (self.opacity * (-0.5 * d2).exp()) as f32;
                }
            }
        }
    }

    /// Tiles that the box reaches along each axis.
    fn reached(&self) -> Option<Reached> {
        Some([self.tiles(0)?, self.tiles(1)?, self.tiles(2)?])
    }
}

type Reached = [RangeInclusive<i32>; 3];

/// Most bytes of [`occupied`]'s lists, without the blocks that it returns.
pub(super) fn working_bytes(scene: &Gaussians, usable: &[u32], lattice: Lattice) -> u64 {
    let n_tiles = |index: &u32| {
        let reached = Ellipsoid::new(scene, *index as usize, lattice).and_then(|of| of.reached());
        reached.map_or(0, |reached| reached.iter().map(|along| along.clone().count() as u64).product())
    };
    let n_pairs: u64 = usable.par_iter().map(n_tiles).sum();
    // Lists double when full.
    (usable.len() * size_of::<Option<Reached>>()) as u64 + n_pairs * 2 * size_of::<u32>() as u64
}

/// Finds the occupied voxels. `usable`: Gaussians, ascending. The result does not depend on threads: each tile has one
/// thread, which adds Gaussians in their order.
pub(super) fn occupied(scene: &Gaussians, usable: &[u32], lattice: Lattice) -> Occupied {
    let ellipsoid = |index: &u32| Ellipsoid::new(scene, *index as usize, lattice);
    let reached: Vec<Option<Reached>> = usable.par_iter().map(|index| ellipsoid(index)?.reached()).collect();
    let n_background = reached.iter().filter(|tiles| tiles.is_none()).count();
    let mut of_tile: BTreeMap<[i32; 3], Vec<u32>> = BTreeMap::new();
    for (index, tiles) in usable.iter().zip(reached) {
        let Some([along_x, along_y, along_z]) = tiles else { continue };
        for x in along_x {
            for y in along_y.clone() {
                for z in along_z.clone() {
                    of_tile.entry([x, y, z]).or_default().push(*index);
                }
            }
        }
    }
    let of_tile: Vec<([i32; 3], Vec<u32>)> = of_tile.into_iter().collect();
    let tiles = of_tile.par_iter().map_init(
        || vec![0f32; TILE_EDGE.pow(3)],
        |sums, (tile, gaussians)| {
            sums.fill(0.0);
            gaussians.iter().filter_map(ellipsoid).for_each(|e| e.add_to(*tile, sums));
            blocks_of(*tile, sums)
        },
    );
    let mut blocks: Vec<(BlockAt, u64)> = tiles.flatten_iter().collect();
    blocks.sort_unstable();
    Occupied { blocks, n_background }
}

fn blocks_of(tile: [i32; 3], sums: &[f32]) -> Vec<(BlockAt, u64)> {
    // 1 - exp(-sum) >= MIN_OPACITY, solved for the sum.
    let least = -(1.0 - MIN_OPACITY).ln();
    let edge = BLOCK_EDGE as usize;
    let places = (0..TILE_BLOCKS)
        .flat_map(|x| (0..TILE_BLOCKS).flat_map(move |y| (0..TILE_BLOCKS).map(move |z| [x, y, z])));
    let mask = |at: [i32; 3]| {
        let [x0, y0, z0] = at.map(|b| (b * BLOCK_EDGE) as usize);
        let mut mask = 0u64;
        for bit in 0..edge.pow(3) {
            let (x, y, z) = (x0 + bit / 16, y0 + bit / 4 % 4, z0 + bit % 4);
            mask |= u64::from(sums[(x * TILE_EDGE + y) * TILE_EDGE + z] >= least) << bit;
        }
        mask
    };
    let block = |at: [i32; 3]| ([0, 1, 2].map(|axis| tile[axis] * TILE_BLOCKS + at[axis]), mask(at));
    places.map(block).filter(|(_, mask)| *mask != 0).collect()
}

#[cfg(test)]
mod tests;
