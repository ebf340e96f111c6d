//! From a photo to the pose of its camera, or to the reason why there is none.

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;

use crate::code::code;
use crate::features::{Feature, features};
use crate::grey::Grey;
use crate::map::Map;
use crate::matching::Query;
use crate::pose::{Match, Pinhole, covariance};
use crate::ransac::{Agreed, locally_refined, ransac};
use crate::render::{Renderer, match_rendering};

/// Features of a photo that are matched.
pub const MAX_FEATURES: usize = 1200;
/// Fewest features with which a place can be recognised.
const MIN_FEATURES: usize = 30;
/// Fewest inliers of a pose that no rendering verifies: twice what photos of other scenes reach.
const MIN_INLIERS: usize = 24;
/// Fewest inliers among matches with a rendering at the pose.
const MIN_RENDERED_INLIERS: usize = 30;
/// Fewest inliers for which a rendering is tried.
const MIN_CANDIDATE_INLIERS: usize = 6;
/// Least spread of the inliers on the photo: standard deviation along their shorter axis, as a share of its width.
const MIN_SPREAD: f64 = 0.04;
/// Largest angle between the stated direction of gravity and the one that the pose gives: 10 degrees.
const MAX_GRAVITY_ANGLE: f64 = 0.175;

/// What is known about a photo besides its pixels.
#[derive(Clone, Copy, Debug)]
pub struct Photo<'a> {
    pub grey: &'a Grey,
    pub intrinsics: &'a Intrinsics,
    /// Direction of gravity in the camera's frame; the world's is down z.
    pub gravity_in_camera: Option<DVec3>,
}

/// A camera that was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Located {
    pub camera_from_world: DAffine3,
    /// Of position and rotation in the world, `[6][6]`; the rotation is a small one about the world's axes.
    pub covariance: [f64; 36],
    pub n_inliers: usize,
    /// Whether a rendering at the pose shows what the photo shows.
    pub is_verified: bool,
}

/// The answer.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    Found(Box<Located>),
    Lost(Reason),
}

/// Why a photo has no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    EmptyMap,
    /// The photo is dark, blurred or plain.
    FewFeatures {
        found: usize,
    },
    /// No pose agrees with enough landmarks.
    NoPose {
        inliers: usize,
    },
    /// The landmarks that agree lie in one corner of the photo.
    NoSpread,
    /// The pose contradicts the direction of gravity.
    Gravity,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::EmptyMap => write!(
                f,
                "no landmarks on board: encode the scene with --locate, and fetch the cells around the robot"
            ),
            Self::FewFeatures { found } => write!(
                f,
                "the photo has {found} features, expected {MIN_FEATURES}: it is dark, blurred or plain"
            ),
            Self::NoPose { inliers } => {
                write!(
                    f,
                    "the best pose agrees with {inliers} landmarks: nothing on board looks like this photo"
                )
            }
            Self::NoSpread => write!(f, "the landmarks that agree lie in one small part of the photo"),
            Self::Gravity => {
                write!(f, "the best pose contradicts the direction of gravity by more than 10 degrees")
            }
        }
    }
}

/// Finds the camera of a photo. Same input, same answer.
pub fn locate(map: &Map, photo: &Photo<'_>, renderer: Option<&dyn Renderer>) -> Outcome {
    if map.is_empty() {
        return Outcome::Lost(Reason::EmptyMap);
    }
    let found = features(photo.grey, MAX_FEATURES);
    if found.len() < MIN_FEATURES {
        return Outcome::Lost(Reason::FewFeatures { found: found.len() });
    }
    let camera = Pinhole::new(photo.intrinsics);
    let at = found.iter().map(|feature| ideal(photo.intrinsics, feature)).collect();
    let query = Query { at, codes: found.iter().map(|feature| code(&feature.descriptor)).collect() };
    let size_px = DVec2::new(f64::from(photo.intrinsics.width_px), f64::from(photo.intrinsics.height_px));
    let Some(agreed) = coarse(map, &query, &camera) else {
        return Outcome::Lost(Reason::NoPose { inliers: 0 });
    };
    let n_coarse = agreed.inliers.len();
    if n_coarse < MIN_CANDIDATE_INLIERS {
        return Outcome::Lost(Reason::NoPose { inliers: n_coarse });
    }
    let guided = query.match_guided(map, &camera, &agreed.camera_from_world, size_px);
    let mut agreed = locally_refined(&camera, agreed.camera_from_world, &guided);
    let mut is_verified = false;
    if let Some(renderer) = renderer {
        let matches =
            match_rendering(renderer, &agreed.camera_from_world, photo.intrinsics, &found, &query.at);
        let seen = ransac(&camera, &matches, SEED);
        let n = seen.as_ref().map_or(0, |seen| seen.inliers.len());
        match seen.filter(|_| n >= MIN_RENDERED_INLIERS) {
            Some(seen) => (agreed, is_verified) = (seen, true),
            None => return Outcome::Lost(Reason::NoPose { inliers: n }),
        }
    } else if n_coarse < MIN_INLIERS {
        return Outcome::Lost(Reason::NoPose { inliers: n_coarse });
    }
    judge(&camera, agreed, photo, size_px, is_verified)
}

/// Seed of all random choices.
const SEED: u64 = 47;

/// Returns the pose on which matches with the map agree, after those of all views or of a few.
fn coarse(map: &Map, query: &Query, camera: &Pinhole) -> Option<Agreed> {
    let all = query.match_all(map);
    let first = ransac(camera, &all, SEED);
    let votes = first.as_ref().filter(|first| first.inliers.len() >= MIN_INLIERS).map(|first| &first.inliers);
    let of_views = query.match_views(map, votes.unwrap_or(&all));
    let second = ransac(camera, &of_views, SEED);
    first.into_iter().chain(second).max_by_key(|agreed| agreed.inliers.len())
}

/// Returns the pose, unless its inliers or gravity speak against it.
fn judge(camera: &Pinhole, agreed: Agreed, photo: &Photo<'_>, size_px: DVec2, is_verified: bool) -> Outcome {
    let Agreed { camera_from_world, inliers, .. } = agreed;
    if spread(&inliers) < MIN_SPREAD * size_px.x {
        return Outcome::Lost(Reason::NoSpread);
    }
    if let Some(gravity) = photo.gravity_in_camera {
        let down = camera_from_world.transform_vector3(DVec3::NEG_Z);
        if down.angle_between(gravity) > MAX_GRAVITY_ANGLE {
            return Outcome::Lost(Reason::Gravity);
        }
    }
    let Some(covariance) = covariance(camera, &camera_from_world, &inliers) else {
        return Outcome::Lost(Reason::NoSpread);
    };
    Outcome::Found(Box::new(Located { camera_from_world, covariance, n_inliers: inliers.len(), is_verified }))
}

/// Returns the standard deviation of the matches' places along their shorter axis, pixels.
fn spread(matches: &[Match]) -> f64 {
    let n = matches.len().max(1) as f64;
    let mean = matches.iter().map(|one| one.at).sum::<DVec2>() / n;
    let [mut xx, mut xy, mut yy] = [0.0; 3];
    for one in matches {
        let d = one.at - mean;
        (xx, xy, yy) = (xx + d.x * d.x / n, xy + d.x * d.y / n, yy + d.y * d.y / n);
    }
    // The smaller eigenvalue of the 2 x 2 covariance.
    let least = 0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
    least.max(0.0).sqrt()
}

/// Returns where an ideal pinhole shows a feature, pixels.
fn ideal(intrinsics: &Intrinsics, feature: &Feature) -> DVec2 {
    let distorted = intrinsics.distorted_from_pixel(feature.at);
    let mut ideal = distorted;
    // A fixed point: lenses of photos that can be undistorted contract.
    for _ in 0..UNDISTORT_ROUNDS {
        let again = intrinsics.distort(ideal);
        ideal = [ideal[0] + distorted[0] - again[0], ideal[1] + distorted[1] - again[1]];
    }
    DVec2::from(intrinsics.pixel_from_distorted(ideal))
}

/// Rounds of the fixed point: a hundredth of a pixel for strong lenses.
const UNDISTORT_ROUNDS: usize = 20;
