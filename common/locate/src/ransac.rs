//! The pose on which most matches agree: samples of three matches (P3P), scored by all (MSAC; Torr and Zisserman
//! 2000), the best refined on its inliers (LO-RANSAC; Chum, Matas and Kittler 2003).

use glam::DAffine3;
use slag_math::random::Random;

use crate::p3p::p3p;
use crate::pose::{Match, Pinhole, refine};

/// Error of an inlier, pixels.
pub(crate) const INLIER_PX: f64 = 5.0;
/// Samples tried at most: 12 % inliers are found with probability 0.9997.
const MAX_SAMPLES: usize = 5000;
/// Probability that a sample of inliers alone was among those tried.
const CONFIDENCE: f64 = 0.9999;
/// Rounds of refinement on the inliers of the best pose.
const LOCAL_ROUNDS: usize = 3;
/// Where errors count half, pixels.
pub(crate) const SOFT_PX: f64 = 2.0;

/// A pose, and the matches that agree with it.
#[derive(Clone, Debug)]
pub(crate) struct Agreed {
    pub(crate) camera_from_world: DAffine3,
    pub(crate) inliers: Vec<Match>,
    /// Sum of squared errors of all matches, each at most that of an inlier's bound.
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

/// Returns the sum of squared errors, each at most that of an inlier's bound; infinite from `limit` on.
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

/// Returns the pose on which most matches agree; `None` where no sample has a pose. Same input, same result.
pub(crate) fn ransac(camera: &Pinhole, matches: &[Match], seed: u64) -> Option<Agreed> {
    let n = matches.len();
    if n < 4 {
        return None;
    }
    let mut random = Random::new(seed);
    let mut best: Option<Agreed> = None;
    let mut needed = MAX_SAMPLES;
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
                // log(1 - p) / log(1 - share^3); the logarithm of 1 less almost nothing is minus that.
                let tries = (1.0 - CONFIDENCE).ln() / (-share.powi(3)).ln_1p();
                needed = if tries < MAX_SAMPLES as f64 { tries.ceil() as usize } else { MAX_SAMPLES };
                best = Some(agreed);
            }
        }
    }
    best
}

/// Refines a pose on its inliers for as long as that lowers its cost.
pub(crate) fn locally_refined(camera: &Pinhole, pose: DAffine3, matches: &[Match]) -> Agreed {
    let mut best = Agreed::of(camera, pose, matches);
    for _ in 0..LOCAL_ROUNDS {
        let refined = (best.inliers.len() >= 4)
            .then(|| refine(camera, &best.camera_from_world, &best.inliers, SOFT_PX))
            .flatten();
        let Some(next) = refined.map(|pose| Agreed::of(camera, pose, matches)) else { break };
        if next.cost >= best.cost {
            break;
        }
        best = next;
    }
    best
}
