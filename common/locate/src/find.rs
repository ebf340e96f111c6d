//! From a photo to the pose of its camera, or the reason why there is none.

use std::cell::OnceCell;

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;

use crate::features::{Feature, MAX_FEATURES, features};
use crate::grey::Grey;
use crate::map::{Map, code};
use crate::matching::Query;
use crate::pose::{FOCAL_SIGMA, Match, POSE, POSE_AND_FOCAL, POSE_AND_LENS, Pinhole};
use crate::pose::{covariance, focal_sigma, lens_distance, refine};
use crate::ransac::{Agreed, INLIER_PX, MAX_SAMPLES, SOFT_PX, locally_refined, ransac, samples};
use crate::render::{Compared, Renderer};

const MIN_FEATURES: usize = 20;
/// Fewest inliers of an unverified pose; photos of other scenes reach 15 at most.
const MIN_INLIERS: usize = 20;
/// The same if a rendering contradicts it: a car in two scenes reaches 33.
const MIN_INLIERS_AGAINST_RENDERING: usize = 40;
/// Fewest inliers of a candidate.
const MIN_UNSURE_INLIERS: usize = 12;
/// A pose elsewhere with this share of the best pose's inliers is a rival.
const RIVAL_SHARE: f64 = 0.7;
/// Fewest inliers among matches with a rendering at the pose; photos of other scenes reach 7 at most.
const MIN_RENDERED_INLIERS: usize = 12;
/// Fewest of these inliers for another rendering, at the pose that they give.
const MIN_NEARER_INLIERS: usize = 8;
/// Inliers of a verified pose from which no other place is tried; of 144 altered photos, one with 53 was wrong.
const MIN_SURE_INLIERS: usize = 100;
/// Largest error of a patch that agrees with a pose, pixels.
const PATCH_INLIER_PX: f64 = 2.0;
/// Fewest patches that verify a pose, and their share of those tried; other scenes reach at most 22, below 3 %.
const MIN_PATCHES: usize = 20;
const MIN_PATCH_SHARE: f64 = 0.04;
/// Most renderings per proposed pose, and most proposed poses with renderings.
const MAX_RENDERINGS: usize = 2;
const MAX_PROPOSALS: usize = 4;
const MIN_PROPOSED_INLIERS: usize = 5;
/// Least spread of inliers on the photo: standard deviation along their shorter axis, as a share of its width.
const MIN_SPREAD: f64 = 0.04;
/// Largest angle between stated direction of gravity and that of the pose: 10 degrees.
const MAX_GRAVITY_ANGLE: f64 = 0.175;

/// Other focal lengths tried, each this many times the one before, up to twice and half the stated one.
const ZOOM_STEP: f64 = 1.1;
const N_ZOOMS: i32 = 8;
/// Most samples for each.
const MAX_ZOOM_SAMPLES: usize = 1000;
/// Rounds of freeing the focal length and matching again.
const FREEING_ROUNDS: usize = 4;
/// Standard deviations by which the landmarks may contradict the stated focal length.
const FOCAL_SIGMAS: f64 = 3.0;
/// Squared Mahalanobis distance by which they may contradict its aspect and principal point.
const MAX_LENS_DISTANCE: f64 = 25.0;

/// A photo with its camera; gravity and a prior where they are known.
#[derive(Clone, Copy, Debug)]
pub struct Photo<'a> {
    pub grey: &'a Grey,
    pub intrinsics: &'a Intrinsics,
    /// Direction of gravity in the camera frame; in the world it is -z.
    pub gravity_in_camera: Option<DVec3>,
    pub prior: Option<Prior>,
}

/// Where a camera may be: poses beyond three standard deviations are refused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    pub position_in_world: DVec3,
    pub sigma: f64,
}

impl Photo<'_> {
    fn contradiction(&self, camera_from_world: &DAffine3) -> Option<Reason> {
        let down = camera_from_world.transform_vector3(DVec3::NEG_Z);
        if self.gravity_in_camera.is_some_and(|gravity| down.angle_between(gravity) > MAX_GRAVITY_ANGLE) {
            return Some(Reason::Gravity);
        }
        let Prior { position_in_world, sigma } = self.prior?;
        let at = camera_from_world.inverse().translation;
        (at.distance(position_in_world) > PRIOR_SIGMAS * sigma).then_some(Reason::Prior)
    }
}

const PRIOR_SIGMAS: f64 = 3.0;

#[derive(Clone, Debug, PartialEq)]
pub struct Located {
    pub camera_from_world: DAffine3,
    /// Covariance `[6][6]` of position and rotation in the world; the rotation is a small one about the world's axes.
    pub covariance: [f64; 36],
    pub n_inliers: usize,
    /// Whether a rendering at the pose matches the photo.
    pub is_verified: bool,
    /// Camera of the pose where the landmarks contradict the stated one.
    pub other_camera: Option<Pinhole>,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    Found(Box<Located>),
    /// Candidate poses, best first; none is certain.
    Unsure(Vec<Located>),
    Lost(Reason),
}

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
    /// Its mirror image agrees with more landmarks. A mirrored wall is a wall seen from behind, also to renderings.
    Mirrored,
    /// The landmarks that agree lie in one corner of the photo.
    NoSpread,
    /// The pose contradicts the direction of gravity.
    Gravity,
    /// The pose is far from where the camera may be.
    Prior,
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
            Self::Mirrored => write!(f, "the photo is mirrored; give it as the camera saw it"),
            Self::NoSpread => write!(f, "the landmarks that agree lie in one small part of the photo"),
            Self::Gravity => {
                write!(f, "the best pose contradicts the direction of gravity by more than 10 degrees")
            }
            Self::Prior => write!(f, "the best pose lies beyond three sigma of the place that was given"),
        }
    }
}

/// Finds the camera of a photo, deterministically. A pose that no rendering verifies needs more inliers.
pub fn locate(map: &Map, photo: &Photo<'_>, renderer: Option<&dyn Renderer>) -> Outcome {
    if map.is_empty() {
        return Outcome::Lost(Reason::EmptyMap);
    }
    let found = features(photo.grey, MAX_FEATURES);
    if found.len() < MIN_FEATURES {
        return Outcome::Lost(Reason::FewFeatures { found: found.len() });
    }
    let query = query(&found, photo.intrinsics);
    let size_px = DVec2::new(f64::from(photo.intrinsics.width_px), f64::from(photo.intrinsics.height_px));
    let all = query.match_all(map);
    let camera = Pinhole::new(photo.intrinsics);
    let search = Search { map, photo, query, all, camera, size_px, zoomed: OnceCell::new() };
    let mut proposals = search.proposals();
    let inliers = proposals.first().map_or(0, |best| best.inliers.len());
    let is_weak = inliers < MIN_INLIERS_AGAINST_RENDERING;
    if is_weak && mirrored_inliers(map, photo) > inliers.max(MIN_UNSURE_INLIERS) {
        return Outcome::Lost(Reason::Mirrored);
    }
    let contradiction = |one: &Agreed| photo.contradiction(&one.camera_from_world);
    let refused = proposals.iter().find_map(contradiction);
    proposals.retain(|one| contradiction(one).is_none());
    if proposals.is_empty() {
        return Outcome::Lost(refused.unwrap_or(Reason::NoPose { inliers }));
    }
    let outcome =
        match renderer.map_or(Verified::NotDrawn, |renderer| search.verified(&proposals, renderer, &found)) {
            Verified::Yes(all) => search.without_rival(all),
            Verified::No => search.unverified(&proposals, MIN_INLIERS_AGAINST_RENDERING),
            Verified::NotDrawn => search.unverified(&proposals, MIN_INLIERS),
        };
    match outcome {
        Outcome::Found(found) if found.other_camera.is_some() => Outcome::Unsure(vec![*found]),
        outcome => outcome,
    }
}

fn query(found: &[Feature], intrinsics: &Intrinsics) -> Query {
    let at = found.iter().map(|feature| ideal(intrinsics, feature)).collect();
    Query { at, codes: found.iter().map(|feature| code(&feature.descriptor)).collect() }
}

/// Landmarks that agree with the photo's mirror image.
fn mirrored_inliers(map: &Map, photo: &Photo<'_>) -> usize {
    let of = photo.intrinsics;
    let intrinsics = Intrinsics { centre_x_px: f64::from(of.width_px) - of.centre_x_px, ..*of };
    let query = query(&features(&photo.grey.mirrored(), MAX_FEATURES), &intrinsics);
    ransac(&Pinhole::new(&intrinsics), &query.match_all(map), SEED, MAX_SAMPLES)
        .map_or(0, |of| of.inliers.len())
}

const SEED: u64 = 47;

/// Result of renderings at proposed poses.
enum Verified {
    /// Poses in distinct places.
    Yes(Vec<Located>),
    No,
    NotDrawn,
}

struct Search<'a> {
    map: &'a Map,
    photo: &'a Photo<'a>,
    query: Query,
    /// Its matches with all landmarks.
    all: Vec<Match>,
    camera: Pinhole,
    size_px: DVec2,
    /// The best fit at other focal lengths, once it is needed.
    zoomed: OnceCell<Option<(Fit, f64)>>,
}

/// A camera with its pose, and the landmarks that agree.
#[derive(Clone, Debug)]
struct Fit {
    camera: Pinhole,
    camera_from_world: DAffine3,
    matches: Vec<Match>,
}

impl Search<'_> {
    /// Returns distinct poses, most inliers first. Matches with all landmarks and with those of a few views are tried;
    /// if the first give too few inliers, also matches with single places, because two places may look alike.
    fn proposals(&self) -> Vec<Agreed> {
        let agreed = |matches: &[Match]| ransac(&self.camera, matches, SEED, MAX_SAMPLES);
        let first = agreed(&self.all);
        let votes =
            first.as_ref().filter(|first| first.inliers.len() >= MIN_INLIERS).map(|first| &first.inliers);
        let second = agreed(&self.query.match_views(self.map, votes.unwrap_or(&self.all)));
        let suffices = votes.is_some();
        let mut found: Vec<Agreed> = first.into_iter().chain(second).collect();
        if !suffices {
            found.extend(self.query.match_places(self.map).filter_map(|matches| agreed(&matches)));
        }
        found.retain(|one| one.inliers.len() >= MIN_PROPOSED_INLIERS);
        found.sort_by_key(|one| std::cmp::Reverse(one.inliers.len()));
        let mut distinct: Vec<Agreed> = Vec::new();
        for one in found {
            if !distinct.iter().any(|other| self.is_same(&one, other)) {
                distinct.push(one);
            }
        }
        distinct
    }

    fn is_same(&self, a: &Agreed, b: &Agreed) -> bool {
        let [a, b] = [a, b].map(|one| one.camera_from_world.inverse().translation);
        a.distance_squared(b) <= SAME_POSE * self.map.same_place
    }

    /// Refines a pose on the landmarks that the photo shows where the pose predicts.
    fn guided(&self, one: &Agreed) -> Agreed {
        let pose = one.camera_from_world;
        let matches = self.query.match_guided(self.map, &self.camera, &pose, self.size_px);
        locally_refined(&self.camera, pose, &matches)
    }

    /// Returns the first proposed pose whose rendering matches the photo.
    fn verified(&self, proposals: &[Agreed], renderer: &dyn Renderer, found: &[Feature]) -> Verified {
        let compared = Compared::new(self.photo.grey, self.photo.intrinsics, found, &self.query.at);
        let mut verified = Verified::NotDrawn;
        for one in proposals.iter().take(MAX_PROPOSALS) {
            match (self.rendered(one, renderer, &compared), &mut verified) {
                (Verified::Yes(located), Verified::Yes(all)) => all.extend(located),
                (yes @ Verified::Yes(_), _) => verified = yes,
                (Verified::No, Verified::NotDrawn) => verified = Verified::No,
                _ => {}
            }
            // Fewer leave room for a place that looks alike.
            let is_sure = |located: &Located| located.n_inliers >= MIN_SURE_INLIERS;
            if matches!(&verified, Verified::Yes(all) if is_sure(&all[0])) {
                break;
            }
        }
        verified
    }

    /// Returns the pose from matches with renderings, each at the pose that the previous one gives.
    fn rendered(&self, one: &Agreed, renderer: &dyn Renderer, compared: &Compared<'_>) -> Verified {
        let landmarks = self.guided(one);
        let mut pose = landmarks.camera_from_world;
        let mut verified = Verified::NotDrawn;
        for _ in 0..MAX_RENDERINGS {
            let Some(rendered) = compared.render(renderer, &pose) else { break };
            verified = Verified::No;
            let seen = ransac(&self.camera, &compared.match_features(&rendered), SEED, MAX_SAMPLES);
            let n = seen.as_ref().map_or(0, |seen| seen.inliers.len());
            let enough = match seen {
                Some(ref seen) if n >= MIN_RENDERED_INLIERS => Some(seen.clone()),
                _ => self.agreed_patches(&compared.match_patches(&rendered)),
            };
            if let Some(enough) = enough {
                let located = self.located(&self.with_landmarks(&landmarks, enough), true);
                return located.map_or(verified, |located| Verified::Yes(vec![located]));
            }
            match seen {
                Some(seen) if n >= MIN_NEARER_INLIERS => pose = seen.camera_from_world,
                _ => break,
            }
        }
        verified
    }

    /// Returns the pose on which patches agree, if they suffice to verify it.
    fn agreed_patches(&self, (matches, n_tried): &(Vec<Match>, usize)) -> Option<Agreed> {
        let mut agreed = ransac(&self.camera, matches, SEED, MAX_SAMPLES)?;
        agreed.inliers.retain(|one| self.camera.error(&agreed.camera_from_world, one) < PATCH_INLIER_PX);
        let n = agreed.inliers.len();
        (n >= MIN_PATCHES && n as f64 >= MIN_PATCH_SHARE * *n_tried as f64).then_some(agreed)
    }

    /// Refines a verified pose on landmarks too: those of the proposed pose, or its own. Where the splat lacks the
    /// texture of photos, landmarks are more and better.
    fn with_landmarks(&self, proposed: &Agreed, verified: Agreed) -> Agreed {
        let own = self.guided(&verified);
        let landmarks = if own.inliers.len() > proposed.inliers.len() { &own } else { proposed };
        let all: Vec<Match> = landmarks.inliers.iter().chain(&verified.inliers).copied().collect();
        let from = |start: &Agreed| locally_refined(&self.camera, start.camera_from_world, &all);
        let refined = [from(landmarks), from(&verified)].into_iter().min_by(|a, b| a.cost.total_cmp(&b.cost));
        let agrees = |pose: &Agreed| {
            let is_inlier = |one: &&Match| self.camera.error(&pose.camera_from_world, one) < INLIER_PX;
            2 * verified.inliers.iter().filter(is_inlier).count() > verified.inliers.len()
        };
        refined.filter(agrees).unwrap_or(verified)
    }

    /// Returns the verified pose, unless poses in other places are as good.
    fn without_rival(&self, mut all: Vec<Located>) -> Outcome {
        all.sort_by_key(|one| std::cmp::Reverse(one.n_inliers));
        let at = |one: &Located| one.camera_from_world.inverse().translation;
        let is_elsewhere =
            |one: &Located| at(one).distance_squared(at(&all[0])) > SAME_POSE * self.map.same_place;
        let least = (RIVAL_SHARE * all[0].n_inliers as f64) as usize;
        match all.iter().any(|one| is_elsewhere(one) && one.n_inliers >= least) {
            true => Outcome::Unsure(all),
            false => Outcome::Found(Box::new(all.swap_remove(0))),
        }
    }

    fn unverified(&self, proposals: &[Agreed], min_inliers: usize) -> Outcome {
        let n = |one: &Agreed| one.inliers.len();
        let most = n(&proposals[0]);
        let enough = |one: &&Agreed| n(one) >= MIN_UNSURE_INLIERS.max((RIVAL_SHARE * most as f64) as usize);
        let candidates: Vec<&Agreed> = proposals.iter().filter(enough).take(MAX_PROPOSALS).collect();
        let (mut told, mut refused) = (Vec::new(), None);
        for one in &candidates {
            match self.located(&self.guided(one), false) {
                Ok(located) => told.push(located),
                Err(reason) => refused = refused.or(Some(reason)),
            }
        }
        match told.as_slice() {
            [] => Outcome::Lost(refused.unwrap_or(Reason::NoPose { inliers: most })),
            [one] if candidates.len() == 1 && most >= min_inliers => Outcome::Found(Box::new(one.clone())),
            _ => Outcome::Unsure(told),
        }
    }

    fn located(&self, agreed: &Agreed, is_verified: bool) -> Result<Located, Reason> {
        let Agreed { camera_from_world, inliers, .. } = agreed;
        if spread(inliers) < MIN_SPREAD * self.size_px.x {
            return Err(Reason::NoSpread);
        }
        if let Some(reason) = self.photo.contradiction(camera_from_world) {
            return Err(reason);
        }
        let start =
            Fit { camera: self.camera, camera_from_world: *camera_from_world, matches: inliers.clone() };
        let (mut fit, mut is_other) = self.with_focal(&start);
        if let Some(free) = self.with_lens(&fit) {
            (fit, is_other) = (free, true);
        }
        let covariance =
            covariance(&fit.camera, &fit.camera_from_world, &fit.matches).ok_or(Reason::NoSpread)?;
        Ok(Located {
            camera_from_world: fit.camera_from_world,
            covariance,
            n_inliers: fit.matches.len(),
            is_verified,
            other_camera: is_other.then_some(fit.camera),
        })
    }

    /// Estimates the focal length too: the stated one counts with its standard deviation. Also returns whether the
    /// landmarks contradict it; then they alone count.
    fn with_focal(&self, start: &Fit) -> (Fit, bool) {
        let zoomed = self.zoomed.get_or_init(|| self.zoomed(start)).clone();
        let fits = self.freed_focal(start).into_iter().chain(zoomed);
        let Some((free, sigma)) = fits.max_by_key(|(fit, _)| fit.matches.len()) else {
            return (start.clone(), false);
        };
        let off = free.camera.log_zoom(&self.camera);
        let variance = FOCAL_SIGMA.powi(2);
        let sum = variance + sigma * sigma;
        if off.abs() > FOCAL_SIGMAS * sum.sqrt() {
            return (free, true);
        }
        let camera = self.camera.zoomed(off * variance / sum);
        let refined = refine::<POSE>(&camera, &start.camera_from_world, &start.matches, SOFT_PX);
        let fit = |(camera, camera_from_world)| Fit { camera, camera_from_world, ..start.clone() };
        (refined.map_or_else(|| start.clone(), fit), false)
    }

    /// Returns the best fit with any aspect and principal point if the landmarks contradict the stated ones: the photo
    /// is cropped or stretched.
    fn with_lens(&self, start: &Fit) -> Option<Fit> {
        let free = self.freed::<POSE_AND_LENS>(start)?;
        let at = (&free.camera, &free.camera_from_world);
        let distance = lens_distance(&self.camera, at, &free.matches)?;
        (distance > MAX_LENS_DISTANCE && free.matches.len() >= start.matches.len()).then_some(free)
    }

    /// Returns the best fit to the landmarks near a camera with any focal length, and the standard deviation of that
    /// focal length's logarithm.
    fn freed_focal(&self, start: &Fit) -> Option<(Fit, f64)> {
        let fit = self.freed::<POSE_AND_FOCAL>(start)?;
        let sigma = focal_sigma(&fit.camera, &fit.camera_from_world, &fit.matches)?;
        Some((fit, sigma))
    }

    fn freed<const N: usize>(&self, start: &Fit) -> Option<Fit> {
        let mut fit = start.clone();
        for _ in 0..FREEING_ROUNDS {
            let (camera, pose) = refine::<N>(&fit.camera, &fit.camera_from_world, &fit.matches, SOFT_PX)?;
            let mut matches = self.query.match_guided(self.map, &camera, &pose, self.size_px);
            matches.retain(|one| camera.error(&pose, one) < INLIER_PX);
            fit = Fit { camera, camera_from_world: pose, matches };
        }
        Some(fit)
    }

    /// Returns the fit from the pose with most inliers at other focal lengths, as [`Self::freed_focal`] does. `than`:
    /// the fit that it must exceed.
    fn zoomed(&self, than: &Fit) -> Option<(Fit, f64)> {
        let is_inlier = |one: &&Match| than.camera.error(&than.camera_from_world, one) < INLIER_PX;
        let share = self.all.iter().filter(is_inlier).count() as f64 / self.all.len() as f64;
        let max_samples = samples(share, MAX_ZOOM_SAMPLES);
        let zooms = (-N_ZOOMS..=N_ZOOMS).filter(|zoom| *zoom != 0);
        let fits = zooms.filter_map(|zoom| {
            let camera = self.camera.zoomed(f64::from(zoom) * ZOOM_STEP.ln());
            let Agreed { camera_from_world, inliers: matches, .. } =
                ransac(&camera, &self.all, SEED, max_samples)?;
            Some(Fit { camera, camera_from_world, matches })
        });
        self.freed_focal(&fits.max_by_key(|fit| fit.matches.len())?)
    }
}

/// Squared distance up to which two camera positions are the same, in units of the map's `same_place`.
const SAME_POSE: f64 = 25.0;

/// Standard deviation of the matches' places along their shorter axis, pixels.
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

/// Returns the position of a feature in an ideal pinhole's image, pixels.
fn ideal(intrinsics: &Intrinsics, feature: &Feature) -> DVec2 {
    let distorted = intrinsics.distorted_from_pixel(feature.at);
    let mut ideal = distorted;
    // Fixed point: lenses of photos that can be undistorted contract.
    for _ in 0..UNDISTORT_ROUNDS {
        let again = intrinsics.distort(ideal);
        ideal = [ideal[0] + distorted[0] - again[0], ideal[1] + distorted[1] - again[1]];
    }
    DVec2::from(intrinsics.pixel_from_distorted(ideal))
}

/// Rounds of the fixed point: a hundredth of a pixel for strong lenses.
const UNDISTORT_ROUNDS: usize = 20;
