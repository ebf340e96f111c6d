//! Finds the mistake that explains why drawings and photos differ, and reports it.

use std::cell::Cell;
use std::fmt;
use std::path::PathBuf;

use glam::{DQuat, DVec3};
use serde::Serialize;
use slag_common::{Gaussians, Similarity};

use super::mistake::{FrameCandidate, FrameCause, Mistake};
use super::suspicion::{Suspicion, at_per_mille, camera_spread, scene_diagonal};
use super::view::{CheckError, CheckView, at_width, mean};
use crate::raster::{LoadedScene, Rasterizer};

/// PSNR from which no mistake goes unnoticed, dB.
pub(super) const FLAWLESS_DB: f64 = 30.0;
/// Least clear gain, of a correction over the given poses or a drawing over a plain colour, dB.
pub(super) const CLEAR_GAIN_DB: f64 = 3.0;
/// Least gain where the data suggest a mistake or only the mistake can cause it, dB.
const SUSPECTED_GAIN_DB: f64 = 0.5;
/// Factor between neighbouring scales of the sweep, and the largest scale; the smallest is its inverse.
const SWEEP_STEP: f64 = 1.06;
const SWEEP_LIMIT: f64 = 64.0;
/// First step of the refinement: rotation in radians, scale in its logarithm, translation in scene diagonals.
const FIRST_STEP: f64 = 0.02;
const HALVINGS: u32 = 6;
/// The same for a focal length, in its logarithm: half the way to the next one tried.
const FIRST_FOCAL_STEP: f64 = 0.1;
/// Smaller gains fit noise of the few small samples, dB: the frame stays as computed.
const REFINED_GAIN_DB: f64 = 1.0;

const LISTED_TRIALS: usize = 10;
/// Pairs of a tile and a Gaussian that all trials may draw, beside 1,000 times those of the inputs as given, which
/// count with at most this many a Gaussian and view: cameras amid the Gaussians draw each of them everywhere.
const MAX_PAIRS: usize = 200_000_000;
const MOST_PAIRS_EACH: usize = 2;
/// A correction is given up after this many views if none looks more like its photo than a plain colour.
const FIRST_VIEWS: usize = 2;

/// A correction that was tried, and the mean PSNR it leads to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Trial {
    pub mistake: Mistake,
    pub psnr_db: f64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// PSNR of the sampled views with the inputs as given, dB.
    pub given_psnr_db: f64,
    /// The mistake whose correction explains the photos, if any does.
    pub mistake: Option<Mistake>,
    /// The similarity from the world of the poses to that of the splat, where the mistake is one.
    pub splat_from_poses: Option<Similarity>,
    /// The best corrections that were tried, best first.
    pub tried: Vec<Trial>,
    /// Diagonal of the box around the middle 90 % of the Gaussians along each axis, world units.
    pub(crate) scene_diagonal: f64,
    /// Largest distance of a camera from the cameras' mean position, world units.
    pub(crate) camera_spread: f64,
    pub advice: Vec<String>,
}

pub(super) struct Means {
    pub(super) psnr_db: f64,
    /// PSNR of photos against their mean colour.
    pub(super) flat_psnr_db: f64,
    pub(super) covered_share: f64,
    pub(super) most_fit: bool,
}

impl Means {
    /// Both the average and most drawings look like their photos: a few good ones raise an average.
    pub(super) fn fit(&self) -> bool {
        self.average_fits() && self.most_fit
    }

    pub(super) fn average_fits(&self) -> bool {
        self.psnr_db >= self.flat_psnr_db + CLEAR_GAIN_DB
    }
}

/// Small copies of some views, and all camera positions.
pub(super) struct Samples {
    /// Ascending.
    indices: Vec<usize>,
    width_px: u32,
    views: Vec<CheckView>,
    /// Name and focal length of the first view, px of its photo.
    focal_of_first: Option<(String, f64)>,
    camera_positions: Vec<DVec3>,
}

impl Samples {
    pub(super) fn new(n_views: usize, n_samples: usize, width_px: u32) -> Self {
        let n = n_samples.clamp(1, n_views);
        let indices = (0..n).map(|i| i * n_views / n).collect();
        Self { indices, width_px, views: Vec::new(), focal_of_first: None, camera_positions: Vec::new() }
    }

    /// Adds a view; its photo is copied only if it is a sample, or none before it tells anything.
    pub(super) fn add(&mut self, index: usize, view: &CheckView) -> Result<(), CheckError> {
        self.camera_positions.push(view.view.camera_from_world.inverse().translation);
        self.focal_of_first.get_or_insert_with(|| (view.name.clone(), view.view.intrinsics.focal_x_px));
        let is_sample = self.indices.binary_search(&index).is_ok() || self.views.is_empty();
        if is_sample || self.views.iter().all(CheckView::is_plain) && !view.is_plain() {
            self.views.push(at_width(view, self.width_px)?);
        }
        Ok(())
    }

    pub(super) fn diagnose(
        &self,
        scene: &Gaussians,
        loaded: &dyn LoadedScene,
        rasterizer: &dyn Rasterizer,
        means: &Means,
        options: &CheckOptions,
    ) -> Result<Diagnosis, CheckError> {
        // A plain photo looks exactly like a drawing that sees nothing.
        let mut samples: Vec<&CheckView> = self.views.iter().filter(|view| !view.is_plain()).collect();
        if samples.is_empty() {
            samples = self.views.iter().collect();
        }
        let (given_psnr_db, n_pairs) = mean_psnr_db(&samples, loaded, None, samples.len())?;
        let n_pairs = n_pairs.min(scene.len() * samples.len() * MOST_PAIRS_EACH);
        let search = Search {
            samples: &samples,
            scene,
            loaded,
            rasterizer,
            flat_psnr_db: mean(samples.iter().map(|view| view.flat_psnr_db())),
            given_psnr_db,
            pairs_left: Cell::new(n_pairs.saturating_mul(1000).saturating_add(MAX_PAIRS)),
            plain_psnr_db: Cell::new(f64::NEG_INFINITY),
            suspected: options
                .suspicions
                .iter()
                .filter_map(|suspicion| suspicion.mistake)
                .flat_map(|mistake| [Some(mistake), mistake.alternative()])
                .flatten()
                .collect(),
        };
        let tried = search.run(&options.frames, means.fit())?;
        let best = tried.first().filter(|best| search.explains(best));
        let mut diagnosis = Diagnosis {
            given_psnr_db: search.given_psnr_db,
            mistake: best.map(|best| best.mistake),
            splat_from_poses: best.and_then(|best| best.mistake.splat_from_poses()),
            tried,
            scene_diagonal: scene_diagonal(scene),
            camera_spread: camera_spread(&self.camera_positions),
            advice: Vec::new(),
        };
        diagnosis.advice = advice(&diagnosis, means);
        if let (Some(Mistake::FocalScale(factor)), Some((name, focal_px))) =
            (diagnosis.mistake, &self.focal_of_first)
        {
            diagnosis.advice.push(format!(
                "{name} has a focal length of {focal_px:.1} px; expected about {:.1} px",
                focal_px * factor
            ));
        }
        if !search.goes_on() {
            let what = "the search ended early: too many Gaussians lie at one place to draw all corrections";
            diagnosis.advice.push(what.into());
        }
        Ok(diagnosis)
    }
}

/// Mean PSNR of the samples, dB, and the number of drawn pairs of a tile and a Gaussian. Ends after `n_first` samples
/// if none of them looks more like its photo than a plain colour.
fn mean_psnr_db(
    samples: &[&CheckView],
    scene: &dyn LoadedScene,
    mistake: Option<Mistake>,
    n_first: usize,
) -> Result<(f64, usize), CheckError> {
    let (mut sum, mut n, mut n_pairs, mut is_like) = (0.0, 0usize, 0usize, false);
    for sample in samples {
        if n == n_first && !is_like {
            break;
        }
        let view = mistake.map_or(sample.view, |mistake| mistake.corrected(&sample.view));
        let drawing = CheckView { view, ..(*sample).clone() }.draw(scene)?;
        let psnr_db = sample.likeness_db(&drawing);
        is_like |= psnr_db > sample.flat_psnr_db();
        (sum, n, n_pairs) = (sum + psnr_db, n + 1, n_pairs.saturating_add(drawing.counters.pairs));
    }
    Ok((sum / n as f64, n_pairs))
}

/// The search for the correction with which drawings match photos best.
struct Search<'a> {
    samples: &'a [&'a CheckView],
    scene: &'a Gaussians,
    loaded: &'a dyn LoadedScene,
    rasterizer: &'a dyn Rasterizer,
    flat_psnr_db: f64,
    given_psnr_db: f64,
    /// The same of the splat without harmonics, as the corrected splats are.
    plain_psnr_db: Cell<f64>,
    pairs_left: Cell<usize>,
    suspected: Vec<Mistake>,
}

impl Search<'_> {
    /// Tries suspected mistakes, those that are easily overlooked, and focal lengths. If drawings and photos differ,
    /// also common mistakes, frames and a sweep of scales, until one explains the photos. Returns the best trials,
    /// those first that explain them; a focal length, a frame of nerfstudio's defaults or a scale is refined if it is the first.
    fn run(&self, frames: &[FrameCandidate], fit: bool) -> Result<Vec<Trial>, CheckError> {
        let mut tried = Vec::new();
        let harmonics = (self.scene.sh_degree > 0).then_some(Mistake::Harmonics);
        let first = self.suspected.iter().copied().chain(harmonics).chain(Mistake::UNNOTICED);
        self.try_all(first, &mut tried)?;
        if !tried.iter().any(|trial| self.settles(trial)) {
            self.try_all(Mistake::focal_lengths(), &mut tried)?;
        }
        if !fit && !tried.iter().any(|trial| self.settles(trial)) {
            let frames = frames.iter().map(|frame| Mistake::Frame(*frame));
            self.try_all(Mistake::common().into_iter().chain(frames), &mut tried)?;
        }
        if !fit && !tried.iter().any(|trial| self.settles(trial)) {
            let n = (SWEEP_LIMIT.ln() / SWEEP_STEP.ln()).floor() as i32;
            let powers = (-n..=n).filter(|power| *power != 0);
            self.try_all(powers.map(|power| Mistake::SceneScale(SWEEP_STEP.powi(power))), &mut tried)?;
        }
        tried.sort_by(|a, b| self.explains(b).cmp(&self.explains(a)).then(b.psnr_db.total_cmp(&a.psnr_db)));
        if let Some(first) = tried.first_mut() {
            *first = self.refined(*first)?;
        }
        tried.truncate(LISTED_TRIALS);
        Ok(tried)
    }

    fn try_all(
        &self,
        mistakes: impl Iterator<Item = Mistake>,
        tried: &mut Vec<Trial>,
    ) -> Result<(), CheckError> {
        for mistake in mistakes.take_while(|_| self.goes_on()) {
            tried.push(self.trial(mistake)?);
        }
        Ok(())
    }

    fn goes_on(&self) -> bool {
        self.pairs_left.get() > 0
    }

    fn trial(&self, mistake: Mistake) -> Result<Trial, CheckError> {
        let (psnr_db, n_pairs) = match mistake.corrected_splat(self.scene) {
            Some(scene) => mean_psnr_db(self.samples, &*self.rasterizer.load(&scene)?, None, FIRST_VIEWS)?,
            None => mean_psnr_db(self.samples, self.loaded, Some(mistake), FIRST_VIEWS)?,
        };
        self.pairs_left.set(self.pairs_left.get().saturating_sub(n_pairs));
        if mistake == Mistake::Harmonics {
            self.plain_psnr_db.set(psnr_db);
        }
        Ok(Trial { mistake, psnr_db })
    }

    /// A correction must be clearly better than the inputs as given, and its drawings must fit by themselves: one that
    /// merely turns black into some colour gains, too.
    fn explains(&self, trial: &Trial) -> bool {
        let is_likely =
            self.suspected.contains(&trial.mistake) || Mistake::UNNOTICED.contains(&trial.mistake);
        let gain_db = if is_likely { SUSPECTED_GAIN_DB } else { CLEAR_GAIN_DB };
        let is_plain = trial.mistake.is_of_splat() && trial.mistake != Mistake::Harmonics;
        let plain_db = if is_plain { self.plain_psnr_db.get() } else { f64::NEG_INFINITY };
        let uncorrected_db = self.given_psnr_db.max(plain_db);
        trial.psnr_db > (uncorrected_db + gain_db).max(self.flat_psnr_db + CLEAR_GAIN_DB)
    }

    /// Of mistakes that leave drawings somewhat like their photos, one may gain a little where another is the right
    /// one: these end the search if the drawings become much like their photos.
    fn settles(&self, trial: &Trial) -> bool {
        let is_slight = Mistake::UNNOTICED.contains(&trial.mistake)
            || matches!(trial.mistake, Mistake::FocalScale(_)) && !self.suspected.contains(&trial.mistake);
        self.explains(trial) && (!is_slight || trial.psnr_db >= ALIKE_DB)
    }

    /// Refines a focal length, or a similarity that is swept or computed from other data than the trainer's (pattern
    /// search, Hooke and Jeeves 1961). Others are exact.
    fn refined(&self, best: Trial) -> Result<Trial, CheckError> {
        // Directions of the search, up and down: focal length or scale, then three rotations and three translations.
        let (n_directions, mut step, n_halvings, least_gain_db) = match best.mistake {
            Mistake::FocalScale(factor) => {
                // Photos of half the size have exactly half the focal length.
                let is_size = factor.log2().fract() == 0.0;
                (2, FIRST_FOCAL_STEP, HALVINGS, if is_size { REFINED_GAIN_DB } else { 0.0 })
            }
            Mistake::SceneScale(_) => (2, FIRST_STEP, HALVINGS + 2, 0.0),
            Mistake::Frame(FrameCandidate { cause: FrameCause::NerfstudioDefaults, .. }) => {
                (14, FIRST_STEP, HALVINGS + 2, REFINED_GAIN_DB)
            }
            _ => return Ok(best),
        };
        let (centre, diagonal) = (at_per_mille(self.scene, 500), scene_diagonal(self.scene));
        let mut found = best;
        for _ in 0..=n_halvings {
            for direction in 0..n_directions {
                if !self.goes_on() {
                    break;
                }
                let step = if direction % 2 == 0 { step } else { -step };
                let moved = |similarity| moved(similarity, direction / 2, step, centre, diagonal);
                let moved = self.trial(match found.mistake {
                    Mistake::Frame(FrameCandidate { cause, splat_from_poses }) => {
                        Mistake::Frame(FrameCandidate { cause, splat_from_poses: moved(splat_from_poses) })
                    }
                    Mistake::SceneScale(factor) => {
                        Mistake::SceneScale(moved(Similarity::from_scale(factor)).scale)
                    }
                    Mistake::FocalScale(factor) => Mistake::FocalScale(factor * f64::exp(step)),
                    other => other,
                })?;
                found = if moved.psnr_db > found.psnr_db { moved } else { found };
            }
            step *= 0.5;
        }
        Ok(if found.psnr_db > best.psnr_db + least_gain_db { found } else { best })
    }
}

/// Moves a similarity a step in a direction, about the scene's centre.
fn moved(similarity: Similarity, direction: usize, step: f64, centre: DVec3, diagonal: f64) -> Similarity {
    let axis = |at: usize| DVec3::from_array(std::array::from_fn(|i| if i == at { 1.0 } else { 0.0 }));
    let mut change = Similarity::IDENTITY;
    match direction {
        0 => change.scale = step.exp(),
        at @ 1..=3 => change.rotation = DQuat::from_axis_angle(axis(at - 1), step),
        at => change.translation = axis(at - 4) * (step * diagonal),
    }
    change.translation += centre - change.rotation * centre * change.scale;
    change.after(&similarity)
}

fn advice(diagnosis: &Diagnosis, means: &Means) -> Vec<String> {
    let mut advice = Vec::new();
    match (diagnosis.mistake, diagnosis.tried.first()) {
        (Some(mistake), Some(best)) => advice.push(format!(
            "likely mistake: {mistake} ({:.2} dB with the correction, {:.2} dB without)",
            best.psnr_db, diagnosis.given_psnr_db
        )),
        _ => {
            advice.push(format!(
                "no common mistake explains it (PSNR {:.1} dB, plain colour {:.1} dB); check that photos, poses and scene \
                 come from the same reconstruction, in one frame",
                means.psnr_db, means.flat_psnr_db
            ));
            if means.covered_share < 0.5 {
                advice.push(format!(
                    "the scene covers {:.0} % of the images; the cameras look away from it or are far from it",
                    means.covered_share * 100.0
                ));
            }
        }
    }
    let Diagnosis { scene_diagonal, camera_spread, .. } = *diagnosis;
    if camera_spread > 0.0 && !(0.05..=200.0).contains(&(scene_diagonal / camera_spread)) {
        advice.push(format!(
            "the scene measures {scene_diagonal:.3} and the cameras spread over {camera_spread:.3}; \
             check that both have the same unit"
        ));
    }
    if let Some(Similarity { scale, rotation, translation }) = diagnosis.splat_from_poses {
        let (axis, angle_rad) = rotation.to_axis_angle();
        advice.push(format!(
            "the splat's world is that of the poses times {scale:.6}, rotated by {:.3} degrees about ({:.4}, {:.4}, {:.4}), \
             then moved by ({:.6}, {:.6}, {:.6}); write it with --write-frame FILE and encode with --splat-frame FILE",
            angle_rad.to_degrees(),
            axis.x,
            axis.y,
            axis.z,
            translation.x,
            translation.y,
            translation.z
        ));
    }
    advice
}

/// A drawing with this PSNR looks much like its photo.
pub(super) const ALIKE_DB: f64 = 25.0;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewCheck {
    pub name: String,
    /// Peak signal-to-noise ratio of the drawing against the photo, dB.
    pub psnr_db: f64,
    /// PSNR of a plane of the photo's mean colour, dB: the score without any knowledge of the scene.
    pub(crate) flat_psnr_db: f64,
    /// Share of the image that the scene covers (alpha above 0.5).
    pub(crate) covered_share: f64,
    pub(crate) visible_gaussians: usize,
    /// The drawing is far less like its photo than those of other views.
    pub(crate) is_far_below: bool,
}

impl ViewCheck {
    /// Returns whether the drawing looks more like the photo than its mean colour does, or much like it: of a bare wall
    /// the mean colour is hard to surpass. One far below others does not fit.
    pub fn fits(&self) -> bool {
        !self.is_far_below && looks_alike(self.psnr_db, self.flat_psnr_db)
    }
}

pub(super) fn looks_alike(psnr_db: f64, flat_psnr_db: f64) -> bool {
    psnr_db >= flat_psnr_db.min(ALIKE_DB)
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckReport {
    pub views: Vec<ViewCheck>,
    pub mean_psnr_db: f64,
    pub(crate) mean_flat_psnr_db: f64,
    pub mean_covered_share: f64,
    /// Largest number of Gaussians that cannot be drawn in a view.
    pub unusable_gaussians: usize,
    /// Why photos were left out: they cannot be read.
    pub unreadable: Vec<String>,
    pub suspicions: Vec<String>,
    /// What else is known of the inputs, a sentence each.
    pub notes: Vec<String>,
    /// Likely mistake; `None` if the drawings match the photos.
    pub diagnosis: Option<Diagnosis>,
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<28} {:>8} {:>14} {:>9} {:>10}",
            "view", "PSNR dB", "plain colour", "covered", "Gaussians"
        )?;
        for view in &self.views {
            let covered = format!("{:.0} %", view.covered_share * 100.0);
            let (psnr_db, flat_db, n) = (view.psnr_db, view.flat_psnr_db, view.visible_gaussians);
            writeln!(f, "{:<28} {psnr_db:>8.2} {flat_db:>14.2} {covered:>9} {n:>10}", view.name)?;
        }
        let covered = format!("{:.0} %", self.mean_covered_share * 100.0);
        writeln!(
            f,
            "{:<28} {:>8.2} {:>14.2} {covered:>9}",
            "mean", self.mean_psnr_db, self.mean_flat_psnr_db
        )?;
        if let Some(first) = self.unreadable.first() {
            writeln!(f, "{} photos are left out, the first: {first}", self.unreadable.len())?;
        }
        for line in self.suspicions.iter().chain(&self.notes) {
            writeln!(f, "{line}")?;
        }
        match &self.diagnosis {
            None if self.mean_psnr_db < ALIKE_DB => writeln!(
                f,
                "the drawings match the photos, at less than the {ALIKE_DB} dB of a good splat: a lens model or poses that are \
                 a little wrong look so, and a short training; the pictures of --out show where"
            ),
            None => writeln!(f, "the drawings match the photos"),
            Some(diagnosis) => {
                writeln!(f, "the inputs do not fit together")?;
                diagnosis.advice.iter().try_for_each(|advice| writeln!(f, "{advice}"))
            }
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct CheckOptions {
    /// Width at which views are compared, pixels. Photos are never enlarged.
    pub width_px: u32,
    /// Folder for a picture of each view (photo left, drawing right); `None` writes no pictures.
    pub pictures_dir: Option<PathBuf>,
    pub diagnosis_width_px: u32,
    /// Number of views in which mistakes are searched, spread evenly over all views.
    pub diagnosis_views: usize,
    /// Similarities between the worlds of poses and splat that are tried beside common mistakes.
    pub frames: Vec<FrameCandidate>,
    pub suspicions: Vec<Suspicion>,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self {
            width_px: 800,
            pictures_dir: None,
            diagnosis_width_px: 240,
            diagnosis_views: 4,
            frames: Vec::new(),
            suspicions: Vec::new(),
        }
    }
}
