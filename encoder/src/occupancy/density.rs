//! Which voxels hold a surface: the opacity of all Gaussians at each voxel, by Beer and Lambert's law.
//!
//! `opacity = 1 - exp(-sum over Gaussians of alpha exp(-d^2 / 2))`, where d is the distance of the voxel's centre from the
//! mean in standard deviations of the Gaussian, widened by [`VOXEL_VARIANCE`] of the voxel's edge squared; d above
//! [`MAX_SIGMAS`] counts nothing.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::occupancy::BLOCK_EDGE;

use super::lattice::{BlockAt, Lattice};

/// Opacity from which a voxel is occupied (splat-transform's, for voxels of 5 cm).
pub const MIN_OPACITY: f32 = 0.1;
/// Distance from a mean, in standard deviations, up to which a Gaussian counts.
pub const MAX_SIGMAS: f64 = 3.0;
/// Variance that widens a Gaussian, in squared edges of a voxel. A surface is thinner than a voxel: without it a voxel's
/// centre beside the surface sees nothing. With 0.15 a closed surface of opaque Gaussians that touches a corner of the voxel,
/// 0.866 edges from its centre, still gives an opacity of 0.16.
pub const VOXEL_VARIANCE: f64 = 0.15;

/// Blocks along an edge of a tile: its sums, 1 MiB, stay in a core's cache.
const TILE_BLOCKS: i32 = 16;
/// Voxels along an edge of a tile.
const TILE_EDGE: usize = (TILE_BLOCKS * BLOCK_EDGE) as usize;
/// Tiles along an axis that a Gaussian may reach into: larger ones are sky and other background that no robot drives into.
const MAX_TILES: i32 = 8;
/// Standard deviation along its shortest axis, world units, above which a Gaussian is fog, sky or other background: the
/// Gaussians of a surface are thin.
const MAX_THICKNESS: f32 = 0.2;

/// The occupied voxels of a scene.
pub(super) struct Occupied {
    /// By place: voxels of each block with at least one.
    pub(super) blocks: Vec<(BlockAt, u64)>,
    /// Gaussians left out as background: larger than 8 tiles, or thicker than [`MAX_THICKNESS`].
    pub(super) n_background: usize,
}

/// A Gaussian on the lattice, in voxels.
struct Ellipsoid {
    mean: DVec3,
    /// Inverse of the widened covariance.
    precision: DMat3,
    /// Half the edges of the box around the part that counts.
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

    /// Returns the voxels along an axis whose centres the box holds.
    fn voxels(&self, axis: usize) -> RangeInclusive<i64> {
        let (mean, reach) = (self.mean[axis], self.reach[axis]);
        (mean - reach - 0.5).ceil() as i64..=(mean + reach - 0.5).floor() as i64
    }

    fn tiles(&self, axis: usize) -> RangeInclusive<i32> {
        let voxels = self.voxels(axis);
        let tile = |voxel: i64| voxel.div_euclid(TILE_EDGE as i64) as i32;
        tile(*voxels.start())..=tile(*voxels.end())
    }

    /// Adds `alpha exp(-d^2 / 2)` to the voxels of a tile, row by row along z: where a row enters and leaves the ellipsoid is
    /// a quadratic equation.
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
}

/// Finds the occupied voxels. `usable`: the Gaussians to take, ascending. The result does not depend on threads: a tile
/// belongs to one, and adds its Gaussians in their order.
pub(super) fn occupied(scene: &Gaussians, usable: &[u32], lattice: Lattice) -> Occupied {
    let ellipsoid = |index: &u32| Ellipsoid::new(scene, *index as usize, lattice);
    let reached: Vec<Option<[RangeInclusive<i32>; 3]>> = usable
        .par_iter()
        .map(|index| {
            let tiles = ellipsoid(index).map(|e| [0, 1, 2].map(|axis| e.tiles(axis)))?;
            tiles.iter().all(|along| along.end() - along.start() < MAX_TILES).then_some(tiles)
        })
        .collect();
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

/// Returns the blocks of a tile that have an occupied voxel.
fn blocks_of(tile: [i32; 3], sums: &[f32]) -> Vec<(BlockAt, u64)> {
    // 1 - exp(-sum) >= least, solved for the sum.
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
mod tests {
    use slag_math::random::Random;

    use super::*;

    fn random_scene(random: &mut Random, n: usize) -> Gaussians {
        let mut scene = Gaussians::default();
        for _ in 0..n {
            scene.means_in_world.push(DVec3::from([0; 3].map(|_| random.between(-2.0, 2.0))));
            let q = DQuat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
            let q = q.normalize();
            scene.rotations_wxyz.push([q.w, q.x, q.y, q.z].map(|v| v as f32));
            scene.scales.push([0; 3].map(|_| (10f64.powf(random.between(-3.0, -0.7))) as f32));
            scene.opacities.push(random.between(0.05, 1.0) as f32);
            scene.sh_dc.push([0.0; 3]);
        }
        scene
    }

    /// Oracle: the definition, in f64, for every voxel and every Gaussian; voxels within a thousandth of the threshold may
    /// fall on either side, since sums are f32.
    #[test]
    fn voxels_are_occupied_as_defined() {
        let mut random = Random::new(17);
        let lattice = Lattice { voxel: 0.1 };
        let scene = random_scene(&mut random, 60);
        let usable: Vec<u32> = (0..60).collect();
        let found: BTreeMap<BlockAt, u64> = occupied(&scene, &usable, lattice).blocks.into_iter().collect();
        let (mut n_occupied, mut n_undecided) = (0, 0);
        for voxel in (-30..30).flat_map(|x| (-30..30).flat_map(move |y| (-30..30).map(move |z| [x, y, z]))) {
            let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * lattice.voxel;
            let sum: f64 = (0..scene.len())
                .map(|k| {
                    let [w, x, y, z] = scene.rotations_wxyz[k].map(f64::from);
                    let own = DQuat::from_xyzw(x, y, z, w).normalize().inverse()
                        * (centre - scene.means_in_world[k]);
                    // In the Gaussian's own axes the widened covariance stays diagonal.
                    let d2: f64 = (0..3)
                        .map(|axis| {
                            let scale = f64::from(scene.scales[k][axis]);
                            own[axis].powi(2) / (scale * scale + VOXEL_VARIANCE * lattice.voxel.powi(2))
                        })
                        .sum();
                    if d2 <= 9.0 { f64::from(scene.opacities[k]) * (-0.5 * d2).exp() } else { 0.0 }
                })
                .sum();
            let opacity = 1.0 - (-sum).exp();
            let block = voxel.map(|v: i32| v.div_euclid(4));
            let [x, y, z] = voxel.map(|v: i32| v.rem_euclid(4));
            let is_occupied = found.get(&block).is_some_and(|mask| mask >> (16 * x + 4 * y + z) & 1 == 1);
            n_occupied += usize::from(is_occupied);
            if (opacity - 0.1).abs() < 1e-3 {
                n_undecided += 1;
                continue;
            }
            assert_eq!(is_occupied, opacity >= 0.1, "{voxel:?}: {opacity}");
        }
        assert!(n_occupied > 200 && n_undecided < n_occupied / 20, "{n_occupied} {n_undecided}");
    }

    /// By hand: a wide thin Gaussian is a surface; a ball of fog and a Gaussian that is wider than 8 tiles of 64 voxels are not.
    #[test]
    fn background_is_left_out() {
        let mut scene = Gaussians::default();
        for (k, scales) in [[1.0, 1.0, 0.02], [0.3, 0.25, 0.3], [4.4, 4.4, 0.02]].into_iter().enumerate() {
            scene.means_in_world.push(DVec3::X * 100.0 * k as f64);
            scene.rotations_wxyz.push([1.0, 0.0, 0.0, 0.0]);
            scene.scales.push(scales);
            scene.opacities.push(0.9);
            scene.sh_dc.push([0.0; 3]);
        }
        let found = occupied(&scene, &[0, 1, 2], Lattice { voxel: 0.05 });
        assert_eq!(found.n_background, 2);
        assert!(!found.blocks.is_empty() && found.blocks.iter().all(|([x, ..], _)| x.abs() < 20));
    }

    /// A plane of opaque Gaussians, 2 mm thick, in any direction: every voxel that it cuts is occupied, and none whose centre
    /// is farther than one and a half edges.
    #[test]
    fn a_thin_surface_has_no_holes() {
        let mut random = Random::new(5);
        let lattice = Lattice { voxel: 0.05 };
        for spacing in [0.012, 0.05, 0.11] {
            let normal = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
            let (u, v) = (normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector()));
            let middle = DVec3::from([0; 3].map(|_| random.between(-5.0, 5.0)));
            let rotation = DQuat::from_rotation_arc(DVec3::Z, normal);
            let n = (0.8 / spacing) as i32;
            let mut scene = Gaussians::default();
            for (i, j) in (-n..=n).flat_map(|i| (-n..=n).map(move |j| (i, j))) {
                scene
                    .means_in_world
                    .push(middle + u * (f64::from(i) * spacing) + v * (f64::from(j) * spacing));
                scene.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|q| q as f32));
                scene.scales.push([(0.62 * spacing) as f32, (0.62 * spacing) as f32, 0.002]);
                scene.opacities.push(0.97);
                scene.sh_dc.push([0.0; 3]);
            }
            let usable: Vec<u32> = (0..scene.len() as u32).collect();
            let found: BTreeMap<BlockAt, u64> =
                occupied(&scene, &usable, lattice).blocks.into_iter().collect();
            let is_occupied = |voxel: [i32; 3]| {
                let [x, y, z] = voxel.map(|v| v.rem_euclid(4));
                let mask = found.get(&voxel.map(|v| v.div_euclid(4)));
                mask.is_some_and(|mask| mask >> (16 * x + 4 * y + z) & 1 == 1)
            };
            for _ in 0..20_000 {
                let at = middle + u * random.between(-0.5, 0.5) + v * random.between(-0.5, 0.5);
                let voxel = (at / lattice.voxel).floor().to_array().map(|v| v as i32);
                assert!(is_occupied(voxel), "{spacing}: {at}");
                let beside = at + normal * random.between(1.5, 3.0) * lattice.voxel;
                let voxel = (beside / lattice.voxel).floor().to_array().map(|v| v as i32);
                let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * lattice.voxel;
                let is_far = (centre - middle).dot(normal) > 1.5 * lattice.voxel;
                assert!(!is_far || !is_occupied(voxel), "{spacing}: {beside}");
            }
        }
    }
}
