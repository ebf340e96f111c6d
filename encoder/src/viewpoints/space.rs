//! The scene as the planner sees it: turned, centred, scaled, with its occupied voxels.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use slag_common::Gaussians;
use slag_math::eigen::eigen_symmetric;

use super::plan::ViewpointError;
use crate::ground::up::{self, TRIMMED};

/// Widest side of the scene without strays: far more than the rasteriser's near plane.
pub(super) const WIDTH: f64 = 10.0;
pub(super) const VOXEL: f64 = WIDTH / 160.0;
const MARGIN: f64 = 4.0;
/// Larger Gaussians are sky or fog, which occupy nothing.
const MAX_SCALE: f32 = 0.1 * WIDTH as f32;
/// Reach of a Gaussian in standard deviations.
const REACH: f64 = 1.5;
const MIN_GAUSSIANS: usize = 100;

pub(super) struct Space {
    /// Axes: z up, x along the longest horizontal side, the scene's middle at the origin.
    pub(super) scene: Gaussians,
    /// Factor by which Gaussians are enlarged.
    pub(super) grown: f32,
    /// Half the size without strays.
    pub(super) half: DVec3,
    plan_from_world: DMat3,
    centre_in_world: DVec3,
    /// World units per unit of the planner.
    scale: f64,
    n: [usize; 3],
    occupied: Vec<bool>,
}

/// Every n-th usable Gaussian, without colours, enlarged so that surfaces stay closed; and which of them are solid.
pub(super) fn thinned(
    scene: &Gaussians,
    stride: usize,
    grown: f32,
) -> Result<(Gaussians, Vec<u32>), ViewpointError> {
    let mut thin = Gaussians::default();
    for i in (0..scene.len()).filter(|i| scene.is_usable(*i)).step_by(stride) {
        thin.means_in_world.push(scene.means_in_world[i]);
        thin.rotations_wxyz.push(scene.rotations_wxyz[i]);
        thin.scales.push(scene.scales[i].map(|scale| scale * grown));
        thin.opacities.push(scene.opacities[i]);
        thin.sh_dc.push([0.0; 3]);
    }
    let solid = up::solid(&thin);
    let n_solid = solid.len();
    if n_solid < MIN_GAUSSIANS {
        return Err(ViewpointError::Refused(format!(
            "no views can be planned: {n_solid} Gaussians are opaque and finite, expected at least {MIN_GAUSSIANS}; give photos \
             with --views"
        )));
    }
    let first = thin.means_in_world[solid[0] as usize];
    if solid.iter().all(|i| thin.means_in_world[*i as usize] == first) {
        let why = format!("no views can be planned: all Gaussians lie at {first}; export the splat again");
        return Err(ViewpointError::Refused(why));
    }
    Ok((thin, solid))
}

impl Space {
    /// Converts a scene, enlarged by a factor, to the planner's axes, and finds its occupied voxels.
    pub(super) fn new(world: &Gaussians, solid: &[u32], grown: f32, up: DVec3) -> Self {
        let x_axis = longest_side(world, solid, up);
        let axes = [x_axis, up.cross(x_axis), up];
        let ranges = axes.map(|axis| up::extent(world, solid, axis).unwrap_or_default());
        let size = DVec3::from_array(ranges.map(|(low, high)| high - low));
        let middle = DVec3::from_array(ranges.map(|(low, high)| 0.5 * (low + high)));
        let world_from_plan = DMat3::from_cols(axes[0], axes[1], axes[2]);
        let (plan_from_world, centre) = (world_from_plan.transpose(), world_from_plan * middle);
        let scale = size.max_element().max(f64::MIN_POSITIVE) / WIDTH;
        let turn = DQuat::from_mat3(&plan_from_world);
        let turned = |[w, x, y, z]: [f32; 4]| {
            let q = turn * DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into()).normalize();
            [q.w, q.x, q.y, q.z].map(|v| v as f32)
        };
        let placed = |at: &DVec3| plan_from_world * (*at - centre) / scale;
        let scene = Gaussians {
            means_in_world: world.means_in_world.iter().map(placed).collect(),
            rotations_wxyz: world.rotations_wxyz.iter().map(|rotation| turned(*rotation)).collect(),
            scales: world.scales.iter().map(|s| s.map(|s| (f64::from(s) / scale) as f32)).collect(),
            opacities: world.opacities.clone(),
            sh_dc: world.sh_dc.clone(),
            ..Gaussians::default()
        };
        let half = 0.5 * size / scale;
        let n = half.to_array().map(|h| (2.0 * (h / VOXEL + MARGIN)).ceil() as usize);
        let occupied = Vec::new();
        let mut space =
            Self { scene, grown, half, plan_from_world, centre_in_world: centre, scale, n, occupied };
        space.occupied = space.occupied(solid);
        space
    }

    pub(super) fn up_in_world(&self) -> DVec3 {
        self.plan_from_world.transpose().z_axis
    }

    pub(super) fn camera_from_world(&self, camera_from_plan: DAffine3) -> DAffine3 {
        let rotation = camera_from_plan.matrix3 * self.plan_from_world;
        let eye_in_plan = -(camera_from_plan.matrix3.transpose() * camera_from_plan.translation);
        let eye = self.centre_in_world + self.plan_from_world.transpose() * eye_in_plan * self.scale;
        DAffine3 { matrix3: rotation, translation: -(rotation * eye) }
    }

    fn occupied(&self, solid: &[u32]) -> Vec<bool> {
        let mut occupied = vec![false; self.n.iter().product()];
        let scene = &self.scene;
        for i in solid.iter().map(|i| *i as usize) {
            if scene.scales[i].into_iter().any(|scale| scale > MAX_SCALE) {
                continue;
            }
            let [w, x, y, z] = scene.rotations_wxyz[i].map(f64::from);
            let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
            let steps = scene.scales[i].map(|s| (REACH * f64::from(s) / VOXEL).ceil() as i32);
            let step = |axis: usize, k: i32| {
                rotation.col(axis) * REACH * f64::from(scene.scales[i][axis]) * f64::from(k)
                    / f64::from(steps[axis].max(1))
            };
            for a in -steps[0]..=steps[0] {
                for b in -steps[1]..=steps[1] {
                    for c in -steps[2]..=steps[2] {
                        let at = scene.means_in_world[i] + step(0, a) + step(1, b) + step(2, c);
                        if let Some(voxel) = self.voxel(at) {
                            occupied[voxel] = true;
                        }
                    }
                }
            }
        }
        occupied
    }

    fn voxel(&self, at: DVec3) -> Option<usize> {
        let [x, y, z] = ((at + self.half) / VOXEL + MARGIN).to_array().map(f64::floor);
        let [nx, ny, nz] = self.n;
        let is_in = |v: f64, n: usize| v >= 0.0 && v < n as f64;
        (is_in(x, nx) && is_in(y, ny) && is_in(z, nz))
            .then(|| (x as usize * ny + y as usize) * nz + z as usize)
    }

    pub(super) fn is_occupied(&self, at: DVec3) -> bool {
        self.voxel(at).is_some_and(|voxel| self.occupied[voxel])
    }

    /// Whether nothing lies within a distance of a point.
    pub(super) fn is_clear(&self, at: DVec3, distance: f64) -> bool {
        let n = (distance / VOXEL).ceil() as i32;
        let mut around = (-n..=n).flat_map(|x| (-n..=n).flat_map(move |y| (-n..=n).map(move |z| [x, y, z])));
        around.all(|offset| {
            let offset = DVec3::from_array(offset.map(f64::from)) * VOXEL;
            offset.length() > distance || !self.is_occupied(at + offset)
        })
    }

    /// Heights of occupied voxels in the column at a point, ascending.
    pub(super) fn column(&self, x: f64, y: f64) -> impl DoubleEndedIterator<Item = f64> + '_ {
        let n = (2.0 * self.half.z / VOXEL) as i32 + MARGIN as i32;
        let heights = (-(MARGIN as i32)..n).map(move |k| -self.half.z + (f64::from(k) + 0.5) * VOXEL);
        heights.filter(move |z| self.is_occupied(DVec3::new(x, y, *z)))
    }

    /// Square lattice over the scene's plan, `step` apart.
    pub(super) fn lattice(&self, step: f64) -> impl Iterator<Item = (f64, f64)> + use<> {
        let along = move |half: f64| {
            let n = (half / step) as i32;
            (-n..=n).map(move |k| f64::from(k) * step)
        };
        let half = self.half;
        along(half.x).flat_map(move |x| along(half.y).map(move |y| (x, y)))
    }
}

/// Horizontal direction of largest extent, with a sign that the Gaussians decide.
fn longest_side(scene: &Gaussians, solid: &[u32], up: DVec3) -> DVec3 {
    let a = up.any_orthonormal_vector();
    let b = up.cross(a);
    let places = || solid.iter().map(|i| scene.means_in_world[*i as usize]);
    let along = |axis: DVec3| {
        let mut values: Vec<f64> = places().map(|at| at.dot(axis)).collect();
        let median = slag_math::stats::median(&mut values).unwrap_or(0.0);
        let (low, high) = slag_math::stats::trimmed_range(&mut values, TRIMMED).unwrap_or_default();
        (median, low, high)
    };
    let (middle_a, low, high) = along(a);
    let (middle_b, ..) = along(b);
    let edge = high - low;
    let mut c = [0.0; 4];
    for at in places() {
        // Far Gaussians count as those at the edge.
        let [u, v] = [at.dot(a) - middle_a, at.dot(b) - middle_b].map(|d| d.clamp(-edge, edge));
        c = [c[0] + u * u, c[1] + u * v, c[2] + u * v, c[3] + v * v];
    }
    let (_, vectors) = eigen_symmetric(c.to_vec(), 2);
    let axis = (a * vectors[0] + b * vectors[1]).normalize();
    let (middle, low, high) = along(axis);
    if middle > 0.5 * (low + high) { -axis } else { axis }
}
