//! What the data alone say against the inputs, without a drawing.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};

use glam::DVec3;
use slag_common::{Distortion, Gaussians, Intrinsics, Similarity, View};
use slag_math::stats::{Rank, quantile};

use super::mistake::{FrameCandidate, FrameCause, Mistake};

/// Least share of the Gaussians that must look wrong: a splat may have a few of any kind.
const MOST: f64 = 0.999;
/// Gaussians from which shares are meaningful.
const MANY: usize = 1000;
/// Opacity of the logit 1.
const ACTIVATED_OPACITY: f32 = 0.7311;
/// Opacity below which a Gaussian is not drawn at all.
const INVISIBLE: f32 = 1.0 / 255.0;
/// No lens has its principal point this far from the photo's middle (relative).
const OFF_CENTRE: f64 = 0.15;
/// No lens has focal lengths with a larger ratio (logarithm).
const UNEQUAL_FOCALS: f64 = 0.15;
/// Fields of view that photos of a scene have, degrees.
const USUAL_DEGREES: std::ops::RangeInclusive<f64> = 3.0..=150.0;
/// Smaller focal lengths are not in pixels, if the principal point is not, either.
const MOST_SHARES: f64 = 16.0;
/// Gaussians below which a splat is hardly one.
const FEW: usize = 10;
/// Worlds of splat and cameras are apart if their middles are this many of their sizes from each other.
const APART: f64 = 10.0;

const AGAIN: &str = "export the splat again, or leave out --activated if it is given";

#[derive(Clone, Debug, PartialEq)]
pub struct Suspicion {
    pub text: String,
    /// The mistake that would explain it, for drawings to confirm.
    pub mistake: Option<Mistake>,
}

impl Suspicion {
    /// What is left to say once `found` explains the photos, or nothing does: advice that drawings contradict is not
    /// given.
    pub(super) fn after_drawing(&self, found: Option<Mistake>) -> Option<String> {
        let Some(mistake) = self.mistake else { return Some(self.text.clone()) };
        let is_found = found.is_some() && [Some(mistake), mistake.alternative()].contains(&found);
        let looks = self.text.split("; ").next().unwrap_or_default();
        (!is_found).then(|| format!("suspected, not confirmed by the drawings: {looks}"))
    }
}

/// Returns what looks wrong in a splat and the poses of its photos.
pub fn suspicions(scene: &Gaussians, views: &[View]) -> Vec<Suspicion> {
    let usable: Vec<usize> = (0..scene.len()).filter(|i| scene.is_usable(*i)).collect();
    let of_text = |text: String| Suspicion { text, mistake: None };
    let of_mistake = |mistake: Mistake| Suspicion { text: mistake.to_string(), mistake: Some(mistake) };
    let mut found: Vec<Suspicion> = undrawable(scene, &usable).into_iter().map(of_text).collect();
    found.extend(activated(scene, &usable).map(of_mistake));
    found.extend(misread(scene, &usable).into_iter().map(of_text));
    // Rounding, too, brings Gaussians to one place.
    found.extend(rounded(scene, &usable).or_else(|| doubled(scene, &usable)).map(of_text));
    found.extend(shifted(scene, views).map(|frame| {
        let [x, y, z] = frame.splat_from_poses.translation.to_array();
        let text = format!(
            "splat and cameras are far apart, by about ({x:.0}, {y:.0}, {z:.0}): one has an offset that the other lacks"
        );
        Suspicion { text, mistake: Some(Mistake::Frame(frame)) }
    }));
    found.extend(intrinsics(&views.iter().map(|view| view.intrinsics).collect::<Vec<_>>()));
    found.extend(repeated(views).map(of_text));
    found
}

/// Most photos share their pose with others, as where poses were never found.
fn repeated(views: &[View]) -> Option<String> {
    let mut n_of_pose: BTreeMap<[u64; 12], usize> = BTreeMap::new();
    for view in views {
        // Zeros of both signs are one.
        *n_of_pose.entry(view.camera_from_world.to_cols_array().map(|x| (x + 0.0).to_bits())).or_default() +=
            1;
    }
    let n: usize = n_of_pose.values().filter(|n| **n > 1).sum();
    let advice = "different photos from one place say little, and poses that were not found look so";
    (views.len() > 2 && 2 * n > views.len())
        .then(|| format!("{n} of {} photos have exactly the pose of another: {advice}", views.len()))
}

/// Gaussians that show nothing, or less than they should.
fn undrawable(scene: &Gaussians, usable: &[usize]) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    if usable.is_empty() {
        found.push("the splat has no Gaussians that can be drawn".into());
    } else if usable.len() < FEW {
        let n = usable.len();
        found.push(format!("the splat has only {n} Gaussians that can be drawn: is it the whole export?"));
    } else if share(usable, |i| scene.scales[i] == [0.0; 3]) > 0.5 {
        found.push(format!("most Gaussians are points without a size; {AGAIN}"));
    } else if usable.iter().all(|i| scene.scales[*i][2] == 0.0) {
        found.push("the Gaussians are flat, as those of 2DGS: their third axis is taken as 0".into());
    }
    let n_lost = scene.len() - usable.len();
    if n_lost > 0 {
        let advice = if 2 * n_lost > scene.len() { "; export the splat again" } else { " and are left out" };
        found.push(format!("{n_lost} of {} Gaussians cannot be drawn{advice}", scene.len()));
    }
    if !usable.is_empty() && share(usable, |i| scene.opacities[i] < INVISIBLE) > MOST {
        found.push(format!("all Gaussians are transparent; {AGAIN}"));
    }
    found
}

/// Columns of the file that may hold other quantities than expected.
fn misread(scene: &Gaussians, usable: &[usize]) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    if usable.len() < MANY {
        return found;
    }
    // Percentages and bytes as logits saturate; surfaces may be opaque on purpose, with a chosen logit.
    let is_saturated = share(usable, |i| scene.opacities[i] >= 1.0) > 0.5;
    if is_saturated && share(usable, |i| scene.opacities[i] > ACTIVATED_OPACITY) > MOST {
        let what = "the file's opacities may be percents or bytes, not logits";
        found.push(format!("all Gaussians are nearly opaque: {what}"));
    }
    if share(usable, |i| scene.sh_dc[i].iter().all(|c| (0.0..=1.0).contains(c))) > MOST {
        let what = "the file's f_dc may be colours of 0 to 1, not harmonics";
        found.push(format!("all Gaussians are pale: {what}"));
    }
    found
}

fn share(usable: &[usize], is: impl Fn(usize) -> bool) -> f64 {
    usable.iter().filter(|i| is(**i)).count() as f64 / usable.len().max(1) as f64
}

/// A scale s read as a logarithm becomes exp(s): above 1, and just above it for most. An opacity of 0 to 1 read as
/// a logit becomes 0.5 to 0.731. Values of 0, which would leave nothing to see, are not meant so.
fn activated(scene: &Gaussians, usable: &[usize]) -> Option<Mistake> {
    // Flat Gaussians have no third scale.
    let given = |i: usize| scene.scales[i].iter().filter(|s| **s != 0.0);
    let scale_share =
        |most: f32| share(usable, |i| given(i).count() > 1 && given(i).all(|s| (1.0..=most).contains(s)));
    let has_size = share(usable, |i| given(i).any(|s| *s > 1.0)) > 0.5;
    let scales = scale_share(f32::INFINITY) > MOST && scale_share(1.5) > 0.5 && has_size;
    let is_visible = share(usable, |i| scene.opacities[i] > 0.501) > 0.5;
    let opacities =
        is_visible && share(usable, |i| (0.5..=ACTIVATED_OPACITY).contains(&scene.opacities[i])) > MOST;
    (usable.len() >= MANY && (scales || opacities)).then_some(Mistake::Activated { scales, opacities })
}

/// Gaussians that agree with an earlier one in position, scales and opacity.
fn doubled(scene: &Gaussians, usable: &[usize]) -> Option<String> {
    let key = |i: &usize| {
        let mut hasher = DefaultHasher::new();
        scene.means_in_world[*i].to_array().map(f64::to_bits).hash(&mut hasher);
        (scene.scales[*i].map(f32::to_bits), scene.opacities[*i].to_bits()).hash(&mut hasher);
        hasher.finish()
    };
    let mut keys: Vec<u64> = usable.iter().map(key).collect();
    keys.sort_unstable();
    let n_doubled = keys.windows(2).filter(|pair| pair[0] == pair[1]).count();
    (usable.len() >= MANY && 10 * n_doubled > usable.len()).then(|| {
        format!(
            "{n_doubled} of {} Gaussians stand where another one alike stands: the splat was joined with itself, \
             and is drawn too dense; export it again",
            scene.len()
        )
    })
}

/// 32-bit coordinates are rounded by more than the size of small Gaussians.
fn rounded(scene: &Gaussians, usable: &[usize]) -> Option<String> {
    let means = || usable.iter().map(|i| scene.means_in_world[*i]);
    let is_f32 = |mean: DVec3| mean.to_array().iter().all(|x| f64::from(*x as f32) == *x);
    if !means().step_by(usable.len() / 1000 + 1).all(is_f32) {
        return None;
    }
    let mut farthest: Vec<f64> = means().map(|mean| mean.abs().max_element()).collect();
    let mut sizes: Vec<f32> =
        usable.iter().map(|i| scene.scales[*i].into_iter().fold(0.0, f32::max)).collect();
    let farthest = quantile(&mut farthest, 500, Rank::After)?;
    let (rounding, size) =
        (farthest * f64::from(f32::EPSILON), f64::from(quantile(&mut sizes, 100, Rank::After)?));
    // Without an offset, the Gaussians are small rather than the coordinates large.
    (rounding > size && size > 0.0 && farthest > scene_diagonal(scene)).then(|| {
        format!(
            "the splat's coordinates are so large that 32 bits round them to {rounding:.1e}, more than its small \
             Gaussians measure ({size:.1e}): subtract an offset before training (UTM coordinates, perhaps)"
        )
    })
}

/// Returns the round offset between splat and cameras that are far apart.
fn shifted(scene: &Gaussians, views: &[View]) -> Option<FrameCandidate> {
    let positions: Vec<DVec3> = views.iter().map(View::position_in_world).collect();
    let cameras = positions.iter().sum::<DVec3>() / positions.len().max(1) as f64;
    let size = scene_diagonal(scene) + camera_spread(&positions);
    let offset = at_per_mille(scene, 500) - cameras;
    if views.is_empty() || offset.length() <= APART * size || size <= 0.0 {
        return None;
    }
    // People subtract round numbers, so a round one near enough is exact.
    let unit = 10f64.powf(size.log10().ceil());
    let translation = (offset / unit).round() * unit;
    let splat_from_poses = Similarity { translation, ..Similarity::IDENTITY };
    translation.is_finite().then_some(FrameCandidate { cause: FrameCause::Shifted, splat_from_poses })
}

/// Returns mistakes that the intrinsics of all photos share.
fn intrinsics(cameras: &[Intrinsics]) -> Vec<Suspicion> {
    let Some(first) = cameras.first() else { return Vec::new() };
    let mistaken = mistaken_centre(cameras, first);
    let centre = mistaken.map(|mistake| Suspicion {
        text: match mistake {
            Mistake::IntrinsicsOfSize(factor) => format!(
                "the principal point belongs to photos {factor:.3} times as large; divide it by {factor:.3}, and the \
                 focal lengths too if they are of those photos"
            ),
            _ => mistake.to_string(),
        },
        mistake: Some(mistake),
    });
    if mistaken.is_some_and(|mistake| mistake != Mistake::CentreAtZero) {
        return centre.into_iter().collect();
    }
    let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, .. } = *first;
    let mut texts = Vec::new();
    if mistaken.is_none() && cameras.iter().all(|camera| is_off(relative_centre(camera))) {
        texts.push(format!(
            "the principal point ({centre_x_px:.1}, {centre_y_px:.1}) px is far from the middle of photos of {width_px} x \
             {height_px} px: check the intrinsics, and that the photos are not cropped"
        ));
    }
    if cameras.iter().all(|camera| (camera.focal_x_px / camera.focal_y_px).ln().abs() > UNEQUAL_FOCALS) {
        texts.push(format!(
            "the focal lengths along x and y, {focal_x_px:.2} and {focal_y_px:.2} px, differ as those of no lens do: one \
             of them is wrong"
        ));
    }
    let is_unusual = |camera: &Intrinsics| {
        // The angles of a fisheye's pixels are no tangents.
        !matches!(camera.distortion, Distortion::Fisheye { .. })
            && !USUAL_DEGREES.contains(&field_of_view_degrees(camera))
    };
    if cameras.iter().all(is_unusual) {
        let degrees = field_of_view_degrees(first);
        texts.push(format!(
            "a focal length of {focal_x_px:.2} px is a field of view of {degrees:.1} degrees: focal lengths are pixels, neither \
             millimetres nor shares of the image"
        ));
    }
    centre.into_iter().chain(texts.into_iter().map(|text| Suspicion { text, mistake: None })).collect()
}

/// The wider of a pinhole camera's angles.
fn field_of_view_degrees(camera: &Intrinsics) -> f64 {
    let x = f64::from(camera.width_px) / camera.focal_x_px;
    let y = f64::from(camera.height_px) / camera.focal_y_px;
    (2.0 * (x.max(y) / 2.0).atan()).to_degrees()
}

/// Principal point in halves of the image's sides.
fn relative_centre(camera: &Intrinsics) -> [f64; 2] {
    let of = |centre_px: f64, side_px: u32| 2.0 * centre_px / f64::from(side_px);
    [of(camera.centre_x_px, camera.width_px), of(camera.centre_y_px, camera.height_px)]
}

fn is_off(centre: [f64; 2]) -> bool {
    centre.iter().any(|at| (at - 1.0).abs() > OFF_CENTRE)
}

/// Mistake of principal points that are all far from the photos' middles in the same way.
fn mistaken_centre(cameras: &[Intrinsics], first: &Intrinsics) -> Option<Mistake> {
    let is_share = |camera: &Intrinsics| {
        let is_within = |centre: f64| centre > 0.0 && centre <= 1.0;
        is_within(camera.centre_x_px) && is_within(camera.centre_y_px) && is_off(relative_centre(camera))
    };
    if cameras.iter().all(is_share) {
        let [width, height] = [first.width_px, first.height_px].map(f64::from);
        // One focal length is a share of the width, two are of their own sides.
        let focal_by = match [first.focal_x_px, first.focal_y_px] {
            [x, y] if x.max(y) >= MOST_SHARES => [1.0; 2],
            [x, y] if x == y => [width; 2],
            _ => [width, height],
        };
        return Some(Mistake::SharesOfImage { centre_by: [width, height], focal_by });
    }
    let is_swapped = |camera: &Intrinsics| {
        let swapped =
            Intrinsics { centre_x_px: camera.centre_y_px, centre_y_px: camera.centre_x_px, ..*camera };
        is_off(relative_centre(camera)) && !is_off(relative_centre(&swapped))
    };
    if cameras.iter().all(is_swapped) {
        return Some(Mistake::CentreSwapped);
    }
    let mut factors = Vec::new();
    for camera in cameras {
        let [x, y] = relative_centre(camera);
        if x == 0.0 || y == 0.0 {
            return Some(Mistake::CentreAtZero);
        }
        if (x / y - 1.0).abs() > OFF_CENTRE || x <= 0.0 {
            return None;
        }
        factors.push((x + y) / 2.0);
    }
    let factor = quantile(&mut factors, 500, Rank::After)?;
    ((factor - 1.0).abs() > OFF_CENTRE).then_some(Mistake::IntrinsicsOfSize(factor))
}

/// Diagonal of the box around the middle 90 % of the means along each axis.
pub(super) fn scene_diagonal(scene: &Gaussians) -> f64 {
    (at_per_mille(scene, 950) - at_per_mille(scene, 50)).length()
}

pub(super) fn at_per_mille(scene: &Gaussians, per_mille: usize) -> DVec3 {
    let along = |axis: usize| {
        let finite = |p: &DVec3| Some(p[axis]).filter(|v| v.is_finite());
        let mut values: Vec<f64> = scene.means_in_world.iter().filter_map(finite).collect();
        quantile(&mut values, per_mille, Rank::Between).unwrap_or_default()
    };
    DVec3::new(along(0), along(1), along(2))
}

pub(super) fn camera_spread(positions: &[DVec3]) -> f64 {
    let centre = positions.iter().sum::<DVec3>() / positions.len().max(1) as f64;
    positions.iter().map(|p| p.distance(centre)).fold(0.0, f64::max)
}
