//! The upward direction: Gaussians of floors, tables and ceilings are flat, and their normals agree.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_math::eigen::eigen_symmetric;
use slag_math::stats::{median, trimmed_range};

/// Directions tried on half of the sphere: the nearest is within 3 degrees.
const N_DIRECTIONS: usize = 1000;
const MAX_NORMALS: usize = 1 << 20;
/// Cosine of the largest angle between agreeing normals, 8 degrees.
const AGREE: f64 = 0.990;
/// Largest ratio of a flat Gaussian's shortest axis to the next: 0.3 leaves those of surfaces.
const FLAT: f64 = 0.3;
/// Least share of the normals for a direction: rooms have 34 %, yards 17 %, a guitar 8 %.
const MIN_SUPPORT: f64 = 0.12;
/// Share of the best direction's support from which another direction is a surface's, too.
const RIVAL: f64 = 0.3;
/// Least spread, relative to the next, above which no axis is vertical.
const MAX_SPREAD: f64 = 0.6;
/// Gaussians below this opacity are no surface, and occupy nothing.
const MIN_OPACITY: f32 = 0.3;
/// The median height must lie this far below the middle, relative to the height, to tell up from down.
const MIN_SKEW: f64 = 0.03;
/// Distance of a sky's Gaussians from the middle, relative to the median one: a level scene ends at 1.4 times it.
const FAR: f64 = 10.0;
/// Trimmed share at either end of an extent.
pub(crate) const TRIMMED: f64 = 0.02;
/// Default without evidence: cameras of photos have y down, and so have most files.
pub(crate) const OF_FILES: DVec3 = DVec3::NEG_Y;

/// How an upward direction is known, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Sign {
    Known,
    /// Surfaces lie across the axis, which may point down.
    Unknown,
    /// The scene is flat across the axis, which may point down. A flat object may stand any way.
    OfSpread,
    Assumed,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Up {
    /// Unit.
    pub(crate) axis: DVec3,
    pub(crate) sign: Sign,
}

/// Finds the vertical: the direction of most normals; of several, such as walls and floors, the one of least extent.
/// Without any, the axis of least spread; without that, the files' own. `solid`: of [`solid`].
pub(crate) fn find(scene: &Gaussians, solid: &[u32]) -> Up {
    let normals = normals(scene, solid);
    let total: f64 = normals.iter().map(|(_, weight)| weight).sum();
    let peaks = if total > 0.0 { peaks(&normals, total) } else { Vec::new() };
    let best = peaks.first().map_or(0.0, |peak| peak.1);
    let is_rival = |peak: &&(DVec3, f64)| peak.1 >= RIVAL * best && best >= MIN_SUPPORT;
    let height = |axis: &DVec3| extent(scene, solid, *axis).map_or(f64::MAX, |(low, high)| high - low);
    let vertical = peaks.iter().filter(is_rival).map(|(axis, _)| *axis);
    let of_normals = vertical.min_by(|a, b| height(a).total_cmp(&height(b)));
    match (of_normals, least_spread(scene, solid)) {
        (Some(axis), _) => with_sign(scene, solid, axis),
        (None, Some(axis)) => Up { axis, sign: Sign::OfSpread },
        (None, None) => Up { axis: OF_FILES, sign: Sign::Assumed },
    }
}

/// Gaussians of surfaces, without those of a sky, which are far beyond the others.
pub(crate) fn solid(scene: &Gaussians) -> Vec<u32> {
    let mut solid: Vec<u32> =
        (0..scene.len() as u32).filter(|i| scene.opacities[*i as usize] >= MIN_OPACITY).collect();
    let place = |i: &u32| scene.means_in_world[*i as usize];
    let centre = DVec3::from([0, 1, 2].map(|axis| {
        let mut along: Vec<f64> = solid.iter().map(|i| place(i)[axis]).collect();
        median(&mut along).unwrap_or(0.0)
    }));
    let mut distances: Vec<f64> = solid.iter().map(|i| place(i).distance(centre)).collect();
    let far = FAR * median(&mut distances).unwrap_or(0.0);
    solid.retain(|i| place(i).distance(centre) <= far);
    solid
}

/// Normals of flat Gaussians, with weights that the largest do not dominate.
fn normals(scene: &Gaussians, solid: &[u32]) -> Vec<(DVec3, f64)> {
    let stride = scene.len().div_ceil(MAX_NORMALS).max(1);
    let flat = solid.iter().step_by(stride).filter_map(|i| {
        let i = *i as usize;
        let scales = scene.scales[i].map(f64::from);
        let mut axes = [0, 1, 2];
        axes.sort_by(|a, b| scales[*a].total_cmp(&scales[*b]));
        let [least, next, most] = axes.map(|axis| scales[axis]);
        let [w, x, y, z] = scene.rotations_wxyz[i].map(f64::from);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        (least < FLAT * next).then(|| (rotation.col(axes[0]), next * most))
    });
    let mut flat: Vec<(DVec3, f64)> = flat.collect();
    let mut areas: Vec<f64> = flat.iter().map(|(_, area)| *area).collect();
    let most = median(&mut areas).unwrap_or(0.0) * 4.0;
    flat.iter_mut().for_each(|(_, area)| *area = area.min(most));
    flat
}

/// Most frequent normals, far apart, best first, with their share of the weight.
fn peaks(normals: &[(DVec3, f64)], total: f64) -> Vec<(DVec3, f64)> {
    // A spiral of equal areas over the upper half of the sphere.
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let direction = |i: usize| {
        let z = (i as f64 + 0.5) / N_DIRECTIONS as f64;
        let (radius, angle) = ((1.0 - z * z).sqrt(), golden * i as f64);
        DVec3::new(radius * angle.cos(), radius * angle.sin(), z)
    };
    let support = |axis: DVec3| {
        let agree = normals.iter().filter(|(normal, _)| normal.dot(axis).abs() >= AGREE);
        agree.map(|(_, weight)| weight).sum::<f64>() / total
    };
    let tried = (0..N_DIRECTIONS).into_par_iter().map(|i| (direction(i), support(direction(i))));
    let mut tried: Vec<(DVec3, f64)> = tried.collect();
    tried.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut found: Vec<(DVec3, f64)> = Vec::new();
    for (start, _) in tried {
        // 37 degrees from other peaks.
        if found.len() < 3 && found.iter().all(|(axis, _)| axis.dot(start).abs() < 0.8) {
            let axis = (0..4).fold(start, |axis, _| refined(normals, axis));
            found.push((axis, support(axis)));
        }
    }
    found.sort_by(|a, b| b.1.total_cmp(&a.1));
    found
}

/// Mean of the normals that agree with an axis.
fn refined(normals: &[(DVec3, f64)], axis: DVec3) -> DVec3 {
    let agree = normals.iter().filter(|(normal, _)| normal.dot(axis).abs() >= AGREE);
    let sum: DVec3 = agree.map(|(normal, weight)| *normal * normal.dot(axis).signum() * *weight).sum();
    sum.try_normalize().unwrap_or(axis)
}

/// Axis of least spread, if it is clearly least.
fn least_spread(scene: &Gaussians, solid: &[u32]) -> Option<DVec3> {
    let places = || solid.iter().map(|i| scene.means_in_world[*i as usize]);
    let mean = places().sum::<DVec3>() / solid.len().max(1) as f64;
    // Far Gaussians count as one at the edge.
    let mut distances: Vec<f64> = places().map(|at| at.distance(mean)).collect();
    let edge = 2.0 * median(&mut distances)?;
    let mut covariance = DMat3::ZERO;
    for at in places() {
        let offset = (at - mean).clamp_length_max(edge);
        covariance += DMat3::from_cols(offset * offset.x, offset * offset.y, offset * offset.z);
    }
    let (values, vectors) = eigen_symmetric(covariance.to_cols_array().to_vec(), 3);
    let axis = DVec3::from_slice(&vectors[6..9]);
    (values[2].max(0.0).sqrt() < MAX_SPREAD * values[1].max(0.0).sqrt()).then_some(axis)
}

/// Positions of some Gaussians along an axis.
fn along(scene: &Gaussians, solid: &[u32], axis: DVec3) -> Vec<f64> {
    solid.iter().map(|i| scene.means_in_world[*i as usize].dot(axis)).collect()
}

/// Range of some Gaussians along an axis, without strays.
pub(crate) fn extent(scene: &Gaussians, solid: &[u32], axis: DVec3) -> Option<(f64, f64)> {
    trimmed_range(&mut along(scene, solid, axis), TRIMMED)
}

/// Points an axis upward: things stand on the ground, so most of a scene lies in the lower half of its height.
fn with_sign(scene: &Gaussians, solid: &[u32], axis: DVec3) -> Up {
    let middle = median(&mut along(scene, solid, axis));
    let (Some((low, high)), Some(middle)) = (extent(scene, solid, axis), middle) else {
        return Up { axis, sign: Sign::Unknown };
    };
    let skew = (0.5 * (low + high) - middle) / (high - low).max(f64::MIN_POSITIVE);
    let sign = if skew.abs() < MIN_SKEW { Sign::Unknown } else { Sign::Known };
    Up { axis: if skew < 0.0 { -axis } else { axis }, sign }
}
