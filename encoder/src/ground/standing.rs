//! What stands on the ground: voxels above it that touch each other.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use slag_common::{Gaussians, View};
use slag_math::stats::median;
use slag_math::union_find::UnionFind;

use super::height::Ground;
use super::up::{self, Up};
use crate::memory::{MemoryPlan, Phase};

pub(crate) const NO_THING: u32 = u32::MAX;

/// Gaussians below this opacity are no surface.
const MIN_OPACITY: f32 = 0.1;
/// Larger Gaussians are sky and haze, resolutions.
const MAX_SCALE: f64 = 30.0;
/// Side of a voxel, resolutions.
const VOXEL: f64 = 4.0;
/// Height from which a place is above the ground, resolutions.
const MIN_HEIGHT: f64 = 2.0;
const MIN_GAUSSIANS: u32 = 10;
/// Wider things, as a share of the ground, are walls and what touches them: a room consists of these.
const MAX_WIDTH: f64 = 0.25;
/// Wider patches of ground, as a share of its width, are roads, lawns and floors, not things: under the sky, and under
/// a roof, where rugs lie.
const MAX_PATCH: [f64; 2] = [0.125, 0.35];
/// Most Gaussians used to measure the ground.
const SAMPLE: usize = 1 << 22;
/// Reach of a Gaussian in standard deviations; with 1, things close together merge.
const REACH: f64 = 0.5;
const AT_ONCE: usize = 1 << 16;
const BITS: u32 = 21;

/// Things on a scene's ground; none by default.
#[derive(Debug, Default)]
pub(crate) struct Standing(Option<Things>);

#[derive(Debug)]
struct Things {
    /// Rotation to axes with z up.
    upright_from_world: DMat3,
    ground: Ground,
    /// World units: median size of a Gaussian.
    resolution: f64,
    /// Voxel, from the origin, that is the middle of those numbered: scenes may lie far from the origin (UTM).
    middle: DVec3,
    /// Ascending.
    voxels: Vec<u64>,
    of_voxel: Vec<u32>,
    /// By thing: narrower than what the scene consists of.
    is_narrow: Vec<bool>,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint {
    n: u32,
    n_standing: u32,
    /// Gaussians on the ground below a wide thing.
    n_roofed: u32,
    /// Corners of the means' box, in upright axes.
    low: DVec2,
    high: DVec2,
}

impl Footprint {
    const NONE: Self =
        Self { n: 0, n_standing: 0, n_roofed: 0, low: DVec2::INFINITY, high: DVec2::NEG_INFINITY };

    /// Union of both.
    pub(crate) fn with(self, other: Self) -> Self {
        Self {
            n: self.n + other.n,
            n_standing: self.n_standing + other.n_standing,
            n_roofed: self.n_roofed + other.n_roofed,
            low: self.low.min(other.low),
            high: self.high.max(other.high),
        }
    }
}

pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    let bytes_per_voxel = size_of::<u64>() + size_of::<u32>();
    memory.reserve(Phase::Always, "what stands on the ground", (n_gaussians * bytes_per_voxel) as u64);
}

impl Standing {
    pub(crate) fn find(scene: &Gaussians, views: &[View]) -> Self {
        Self::below(scene, up_by(scene, views).axis)
    }

    pub(crate) fn below(scene: &Gaussians, up_in_world: DVec3) -> Self {
        Self(Things::find(scene, up_in_world))
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.as_ref().is_none_or(|things| things.voxels.is_empty())
    }

    pub(crate) fn n_things(&self) -> usize {
        self.0.as_ref().map_or(0, |things| things.is_narrow.len())
    }

    /// Thing at a point, or [`NO_THING`].
    pub(crate) fn at(&self, point_in_world: DVec3) -> u32 {
        let thing = |things: &Things| {
            let voxel = things.voxel_of(things.upright_from_world * point_in_world)?;
            things.of(voxel)
        };
        self.0.as_ref().and_then(thing).unwrap_or(NO_THING)
    }

    /// Footprint of each of `n_parts`; empty if no ground was found. `part_of`: of each Gaussian.
    pub(crate) fn footprints(&self, scene: &Gaussians, part_of: &[u32], n_parts: usize) -> Vec<Footprint> {
        let Some(things) = &self.0 else { return Vec::new() };
        let lies = |mean: &DVec3| {
            let point = things.upright_from_world * *mean;
            let is_standing = things.voxel_of(point).is_some_and(|voxel| things.of(voxel).is_some());
            (is_standing, !is_standing && things.is_roofed(point))
        };
        let mut found = vec![Footprint::NONE; n_parts];
        for (means, part_of) in scene.means_in_world.chunks(AT_ONCE).zip(part_of.chunks(AT_ONCE)) {
            let lie: Vec<(bool, bool)> = means.par_iter().map(lies).collect();
            for ((mean, (is_standing, is_roofed)), part) in means.iter().zip(lie).zip(part_of) {
                let Some(of_part) = found.get_mut(*part as usize) else { continue };
                let at = (things.upright_from_world * *mean).truncate();
                let (n_standing, n_roofed) = (u32::from(is_standing), u32::from(is_roofed));
                *of_part = of_part.with(Footprint { n: 1, n_standing, n_roofed, low: at, high: at });
            }
        }
        found
    }

    /// Mostly ground, and wider than things that lie on it.
    pub(crate) fn is_bare_ground(&self, footprint: &Footprint) -> bool {
        let Footprint { n, n_standing, n_roofed, low, high } = *footprint;
        let most = MAX_PATCH[usize::from(2 * n_roofed > n - n_standing)];
        let is_wide = |things: &Things| (high - low).max_element() > most * things.ground.width;
        2 * n_standing < n && self.0.as_ref().is_some_and(is_wide)
    }

    /// Narrow thing at a point or within a voxel of it, which is the accuracy of a drawing's depth; or [`NO_THING`].
    pub(crate) fn shown_at(&self, point_in_world: DVec3) -> u32 {
        let thing = |things: &Things| {
            let voxel = things.voxel_of(things.upright_from_world * point_in_world)?;
            let beside = steps().flat_map(|step| [voxel.wrapping_add(step), voxel.wrapping_sub(step)]);
            let thing = std::iter::once(voxel).chain(beside).find_map(|voxel| things.of(voxel))?;
            things.is_narrow[thing as usize].then_some(thing)
        };
        self.0.as_ref().and_then(thing).unwrap_or(NO_THING)
    }
}

impl Things {
    fn find(scene: &Gaussians, up: DVec3) -> Option<Self> {
        let x_axis = up.any_orthonormal_vector();
        let upright_from_world = DMat3::from_cols(x_axis, up.cross(x_axis), up).transpose();
        let is_surface = |i: &usize| scene.opacities[*i] >= MIN_OPACITY && scene.is_usable(*i);
        let axes = |i: usize| larger_axes(scene, i);
        let sample = || (0..scene.len()).step_by(scene.len().div_ceil(SAMPLE).max(1)).filter(is_surface);
        let resolution = median(&mut sample().map(|i| axes(i)[0]).collect::<Vec<f64>>())?;
        let is_fine = |i: &usize| axes(*i)[1] < MAX_SCALE * resolution;
        let upright = |i: usize| upright_from_world * scene.means_in_world[i];
        let area = |i: usize| axes(i)[0] * axes(i)[1] * f64::from(scene.opacities[i]);
        let points: Vec<(DVec3, f64)> = sample().filter(is_fine).map(|i| (upright(i), area(i))).collect();
        let ground = Ground::find(&points, resolution)?;
        let some = || points.iter().step_by(points.len() / 1000 + 1);
        let along = |axis: usize| median(&mut some().map(|(at, _)| at[axis]).collect::<Vec<f64>>());
        let middle = (DVec3::new(along(0)?, along(1)?, along(2)?) / (VOXEL * resolution)).floor();
        let (voxels, of_voxel, is_narrow) = (Vec::new(), Vec::new(), Vec::new());
        let mut things = Self { upright_from_world, ground, resolution, middle, voxels, of_voxel, is_narrow };
        let solid = (0..scene.len()).into_par_iter().filter(|i| is_surface(i) && is_fine(i));
        let touched = |i: usize| {
            let (things, mean) = (&things, scene.means_in_world[i]);
            reaches(scene, i, VOXEL * resolution).into_iter().filter_map(move |reach| {
                let voxel = things.voxel_of(upright_from_world * (mean + reach))?;
                Some((voxel, reach == DVec3::ZERO))
            })
        };
        let mut touched: Vec<(u64, bool)> = solid.flat_map_iter(touched).collect();
        touched.par_sort_unstable();
        things.join(&touched);
        Some(things)
    }

    /// Voxel of a point in upright axes; `None` on or below the ground, and far from the scene.
    fn voxel_of(&self, point: DVec3) -> Option<u64> {
        let is_above = self.ground.height_of(point) >= MIN_HEIGHT * self.resolution;
        self.place_of(point).filter(|_| is_above)
    }

    /// Like `voxel_of`, but on and below the ground, too.
    fn place_of(&self, point: DVec3) -> Option<u64> {
        let half = f64::from(1_u32 << (BITS - 1));
        let at = (point / (VOXEL * self.resolution)).floor() - self.middle + half;
        let is_within = at.min_element() >= 1.0 && at.max_element() < 2.0 * half - 1.0;
        is_within.then(|| at.to_array().into_iter().fold(0, |key, at| key << BITS | at as u64))
    }

    fn is_roofed(&self, point: DVec3) -> bool {
        let Some(place) = self.place_of(point) else { return false };
        let top_of_column = place | ((1 << BITS) - 1);
        let n_up_to = self.voxels.partition_point(|voxel| *voxel <= top_of_column);
        n_up_to.checked_sub(1).is_some_and(|highest| {
            self.voxels[highest] > place && !self.is_narrow[self.of_voxel[highest] as usize]
        })
    }

    fn of(&self, voxel: u64) -> Option<u32> {
        self.voxels.binary_search(&voxel).ok().map(|at| self.of_voxel[at])
    }

    /// Joins touching voxels. `touched`: ascending, and whether it contains a Gaussian's mean.
    fn join(&mut self, touched: &[(u64, bool)]) {
        let of_voxel =
            |same: &[(u64, bool)]| (same[0].0, same.iter().filter(|(_, has_mean)| *has_mean).count() as u32);
        let (voxels, n_gaussians): (Vec<u64>, Vec<u32>) =
            touched.chunk_by(|a, b| a.0 == b.0).map(of_voxel).unzip();
        let mut sets = UnionFind::new(voxels.len());
        for (i, voxel) in (0u32..).zip(&voxels) {
            for other in steps().filter_map(|step| voxels.binary_search(&(voxel + step)).ok()) {
                let (a, b) = (sets.root(i), sets.root(other as u32));
                sets.attach(a.max(b), a.min(b));
            }
        }
        let numbering = sets.number(0..voxels.len() as u32);
        let mut n_of_set = vec![0; numbering.sizes.len()];
        for (set, n) in numbering.of_item.iter().zip(&n_gaussians) {
            n_of_set[*set as usize] += n;
        }
        let is_thing = |at: &u32| n_of_set[numbering.of_item[*at as usize] as usize] >= MIN_GAUSSIANS;
        let of_things = sets.number((0..voxels.len() as u32).filter(is_thing));
        let mut sides = vec![[[u64::MAX, 0]; 2]; of_things.sizes.len()];
        for (voxel, thing) in voxels.iter().zip(&of_things.of_item).filter(|(_, thing)| **thing != NO_THING) {
            let at = [voxel >> (2 * BITS), voxel >> BITS & ((1 << BITS) - 1)];
            for ([low, high], at) in sides[*thing as usize].iter_mut().zip(at) {
                (*low, *high) = ((*low).min(at), (*high).max(at));
            }
        }
        let most = MAX_WIDTH * self.ground.width / (VOXEL * self.resolution);
        self.is_narrow =
            sides.iter().map(|sides| sides.iter().all(|[low, high]| ((high - low) as f64) < most)).collect();
        (self.voxels, self.of_voxel) =
            voxels.into_iter().zip(of_things.of_item).filter(|(_, thing)| *thing != NO_THING).unzip();
    }
}

/// The two larger standard deviations, ascending.
fn larger_axes(scene: &Gaussians, i: usize) -> [f64; 2] {
    let mut scales = scene.scales[i].map(f64::from);
    scales.sort_by(f64::total_cmp);
    [scales[1], scales[2]]
}

/// The mean of a Gaussian and places around it, at most a voxel apart: Gaussians of plain walls are larger than voxels.
fn reaches(scene: &Gaussians, i: usize, side: f64) -> Vec<DVec3> {
    // A needle reaches as far as it is wide: its length would join things close together.
    let middle = larger_axes(scene, i)[0];
    let scales = scene.scales[i].map(|scale| f64::from(scale).min(middle));
    let steps = scales.map(|scale| (scale / side + 0.5) as i32);
    if steps == [0; 3] {
        return vec![DVec3::ZERO];
    }
    let [w, x, y, z] = scene.rotations_wxyz[i].map(f64::from);
    let world_from_axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let along = |axis: usize| {
        let n = steps[axis];
        (-n..=n).map(move |k| f64::from(k) * REACH * scales[axis] / f64::from(n.max(1)))
    };
    let places =
        along(0).flat_map(|x| along(1).flat_map(move |y| along(2).map(move |z| DVec3::new(x, y, z))));
    places.map(|place| world_from_axes * place).collect()
}

/// Steps to the voxels that share a face or an edge: 9 of 18, the rest by symmetry.
fn steps() -> impl Iterator<Item = u64> {
    let [x, y, z] = [1 << (2 * BITS), 1 << BITS, 1];
    [x, y, z, x + y, x - y, x + z, x - z, y + z, y - z].into_iter()
}

/// The upward direction. The Gaussians determine the axis, the views its sign: most have the sky above them or the ground
/// before them.
pub(crate) fn up_by(scene: &Gaussians, views: &[View]) -> Up {
    let Up { axis, sign } = up::find(scene, &up::solid(scene));
    let away = |view: &View| {
        let world_from_camera = view.camera_from_world.inverse().matrix3;
        -(world_from_camera.y_axis + world_from_camera.z_axis).dot(axis)
    };
    Up { axis: if views.iter().map(away).sum::<f64>() < 0.0 { -axis } else { axis }, sign }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a field of 30 x 30 m, half of it roofed, a Gaussian every 10 cm. An eighth is 3.75 m, 0.35 is 10.5 m.
    #[test]
    fn a_wide_patch_is_bare_ground_and_under_a_roof_a_wider_one() {
        let field = (0..90_000).map(|i| (f64::from(i % 300) * 0.1, f64::from(i / 300) * 0.1));
        let roof = field.clone().filter(|(x, _)| *x < 15.0).map(|(x, y)| DVec3::new(x, y, 3.0));
        let means = field.map(|(x, y)| DVec3::new(x, y, 0.0)).chain(roof).collect();
        let mut scene = Gaussians::balls(means, 0.1);
        scene.scales.fill([0.1, 0.1, 0.01]);
        scene.opacities.fill(0.9);
        // A voxel has 0.4 m. UTM's northings reach 10,000 km.
        let utm = DVec3::new(4e5, 8e6, 0.0);
        scene.means_in_world.iter_mut().for_each(|mean| *mean += utm);
        let standing = Standing(Things::find(&scene, DVec3::Z));
        let is_bare = |x: f64, width: f64, z: f64| {
            let is_part = |mean: &DVec3| {
                let at = *mean - utm;
                (x..x + width).contains(&at.x) && at.y < 2.0 && at.z == z
            };
            let part_of: Vec<u32> =
                scene.means_in_world.iter().map(|mean| u32::from(!is_part(mean))).collect();
            standing.is_bare_ground(&standing.footprints(&scene, &part_of, 1)[0])
        };
        assert_eq!([3.5, 4.2].map(|width| is_bare(20.0, width, 0.0)), [false, true]);
        assert_eq!([10.0, 11.0].map(|width| is_bare(1.0, width, 0.0)), [false, true]);
        assert!(!is_bare(1.0, 13.0, 3.0), "a roof stands");
    }
}
