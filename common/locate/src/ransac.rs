//! The pose on which most matches agree: samples of three matches (P3P), scored by all (MSAC; Torr and Zisserman
//! 2000), the best refined on its inliers (LO-RANSAC; Chum, Matas and Kittler 2003).

use glam::{DAffine3, DMat3, DVec3};
use slag_common::camera::roots_between;
use slag_math::random::Random;

use crate::pose::{Match, POSE, Pinhole, refine};

pub(crate) const INLIER_PX: f64 = 5.0;
/// Most samples tried for a pose: 12 % inliers are found with probability 0.9997.
pub(crate) const MAX_SAMPLES: usize = 5000;
/// Probability that one of the samples had inliers only.
const CONFIDENCE: f64 = 0.9999;
/// Rounds of refinement on the best pose's inliers.
const LOCAL_ROUNDS: usize = 3;
/// Error that counts half, pixels.
pub(crate) const SOFT_PX: f64 = 2.0;

#[derive(Clone, Debug)]
pub(crate) struct Agreed {
    pub(crate) camera_from_world: DAffine3,
    pub(crate) inliers: Vec<Match>,
    /// Sum of squared errors of all matches, each capped at an inlier's bound.
    pub(crate) cost: f64,
}

impl Agreed {
    fn of(camera: &Pinhole, pose: DAffine3, matches: &[Match]) -> Self {
        let inliers = matches.iter().filter(|one| camera.error(&pose, one) < INLIER_PX);
        Self {
            camera_from_world: pose,
            inliers: inliers.copied().collect(),
            cost: cost(camera, &pose, matches, f64::INFINITY),
        }
    }
}

/// Sum of squared errors, each capped at an inlier's bound; infinite from `limit` on.
fn cost(camera: &Pinhole, pose: &DAffine3, matches: &[Match], limit: f64) -> f64 {
    let mut sum = 0.0;
    for one in matches {
        sum += camera.error(pose, one).min(INLIER_PX).powi(2);
        if sum >= limit {
            return f64::INFINITY;
        }
    }
    sum
}

/// Returns the pose with most inliers of at most `max_samples`; `None` if no sample has a pose. Deterministic.
pub(crate) fn ransac(camera: &Pinhole, matches: &[Match], seed: u64, max_samples: usize) -> Option<Agreed> {
    let n = matches.len();
    if n < 4 {
        return None;
    }
    let mut random = Random::new(seed);
    let mut best: Option<Agreed> = None;
    let mut needed = max_samples;
    let mut tried = 0;
    while tried < needed {
        tried += 1;
        let sample = [random.below(n), random.below(n), random.below(n)].map(|i| matches[i]);
        let rays = sample.map(|one| camera.ray(one.at));
        for pose in p3p(rays, sample.map(|one| one.point_in_world)) {
            let limit = best.as_ref().map_or(f64::INFINITY, |best| best.cost);
            if cost(camera, &pose, matches, limit) == f64::INFINITY {
                continue;
            }
            let agreed = locally_refined(camera, pose, matches);
            if agreed.cost < limit {
                let share = agreed.inliers.len() as f64 / n as f64;
                needed = samples(share, max_samples);
                best = Some(agreed);
            }
        }
    }
    best
}

/// Returns the number of samples that find a share of inliers, at most `max`.
pub(crate) fn samples(share: f64, max: usize) -> usize {
    // log(1 - p) / log(1 - share^3), with `ln_1p` for small shares.
    let tries = (1.0 - CONFIDENCE).ln() / (-share.powi(3)).ln_1p();
    if tries < max as f64 { tries.ceil() as usize } else { max }
}

/// Refines a pose on its inliers while that lowers its cost.
pub(crate) fn locally_refined(camera: &Pinhole, pose: DAffine3, matches: &[Match]) -> Agreed {
    let mut best = Agreed::of(camera, pose, matches);
    for _ in 0..LOCAL_ROUNDS {
        let refined = (best.inliers.len() >= 4)
            .then(|| refine::<POSE>(camera, &best.camera_from_world, &best.inliers, SOFT_PX))
            .flatten();
        let Some(next) = refined.map(|(_, pose)| Agreed::of(camera, pose, matches)) else { break };
        if next.cost >= best.cost {
            break;
        }
        best = next;
    }
    best
}

/// Largest ratio of two distances from the camera that is searched.
const MAX_RATIO: f64 = 1e4;
/// Newton steps on the distances, from bisection's precision to that of f64.
const POLISHING_STEPS: usize = 3;

/// Returns the poses (`camera_from_world`) that see three points in three directions: at most four. `rays`: unit
/// vectors, camera frame. Collinear or coinciding points have none.
pub fn p3p(rays: [DVec3; 3], points_in_world: [DVec3; 3]) -> Vec<DAffine3> {
    let [p1, p2, p3] = points_in_world;
    let (a2, b2, c2) = (p2.distance_squared(p3), p1.distance_squared(p3), p1.distance_squared(p2));
    if a2.min(b2).min(c2) <= 0.0 {
        return Vec::new();
    }
    let [alpha, beta, gamma] = [rays[1].dot(rays[2]), rays[0].dot(rays[2]), rays[0].dot(rays[1])];
    let d = (a2 - c2) / b2;
    let (ab, cb) = (a2 / b2, c2 / b2);
    let sum = (a2 + c2) / b2;
    // In v, the ratio of the third distance to the first; from the constant term up.
    let quartic = [
        (1.0 + d).powi(2) - 4.0 * ab * gamma * gamma,
        4.0 * (-d * (1.0 + d) * beta + 2.0 * ab * gamma * gamma * beta - (1.0 - sum) * alpha * gamma),
        2.0 * (d * d - 1.0 + 2.0 * d * d * beta * beta + 2.0 * (1.0 - cb) * alpha * alpha
            - 4.0 * sum * alpha * beta * gamma
            + 2.0 * (1.0 - ab) * gamma * gamma),
        4.0 * (d * (1.0 - d) * beta - (1.0 - sum) * alpha * gamma + 2.0 * cb * alpha * alpha * beta),
        (d - 1.0).powi(2) - 4.0 * cb * alpha * alpha,
    ];
    let roots = roots_between(&quartic, 0.0, MAX_RATIO).into_iter();
    let pose = |v: f64| {
        let u = ((d - 1.0) * v * v - 2.0 * d * beta * v + 1.0 + d) / (2.0 * (gamma - v * alpha));
        let s1 = (b2 / (1.0 + v * v - 2.0 * v * beta)).sqrt();
        let lengths = polish([s1, u * s1, v * s1], [alpha, beta, gamma], [a2, b2, c2]);
        let is_ahead = lengths.iter().all(|s| *s > 0.0 && s.is_finite());
        let in_camera = [0, 1, 2].map(|i| rays[i] * lengths[i]);
        is_ahead.then(|| align(in_camera, points_in_world)).flatten()
    };
    roots.filter_map(pose).collect()
}

/// Improves the distances of the three points, so that those between them are as given (law of cosines).
fn polish([mut s1, mut s2, mut s3]: [f64; 3], [alpha, beta, gamma]: [f64; 3], between: [f64; 3]) -> [f64; 3] {
    for _ in 0..POLISHING_STEPS {
        let error = DVec3::new(
            s2 * s2 + s3 * s3 - 2.0 * s2 * s3 * alpha - between[0],
            s1 * s1 + s3 * s3 - 2.0 * s1 * s3 * beta - between[1],
            s1 * s1 + s2 * s2 - 2.0 * s1 * s2 * gamma - between[2],
        );
        let columns = DMat3::from_cols(
            2.0 * DVec3::new(0.0, s1 - s3 * beta, s1 - s2 * gamma),
            2.0 * DVec3::new(s2 - s3 * alpha, 0.0, s2 - s1 * gamma),
            2.0 * DVec3::new(s3 - s2 * alpha, s3 - s1 * beta, 0.0),
        );
        let step = columns.inverse() * error;
        if !step.is_finite() {
            break;
        }
        (s1, s2, s3) = (s1 - step.x, s2 - step.y, s3 - step.z);
    }
    [s1, s2, s3]
}

/// Returns the rigid transform between congruent triangles.
fn align(in_camera: [DVec3; 3], in_world: [DVec3; 3]) -> Option<DAffine3> {
    let frame = |[a, b, c]: [DVec3; 3]| {
        let x = (b - a).try_normalize()?;
        let z = x.cross(c - a).try_normalize()?;
        Some(DMat3::from_cols(x, z.cross(x), z))
    };
    let rotation = frame(in_camera)? * frame(in_world)?.transpose();
    let translation = in_camera[0] - rotation * in_world[0];
    translation.is_finite().then_some(DAffine3 { matrix3: rotation, translation })
}

#[cfg(test)]
mod tests;
