//! The search for the correction with which drawings match photos best.

use glam::{DQuat, DVec3};
use slag_common::Similarity;

use super::error::CheckError;
use super::frames::{FrameCandidate, FrameCause};
use super::mistake::{CAMERA_CONVENTIONS, Mistake, single_mistakes};
use super::trial::Trial;

/// Factor between neighbouring scales of the sweep, and the largest scale; the smallest is its inverse.
const SWEEP_STEP: f64 = 1.06;
const SWEEP_LIMIT: f64 = 64.0;
/// First step of the refinement: rotation in radians, scale in its logarithm, translation in scene diagonals.
const FIRST_STEP: f64 = 0.02;
/// Number of times that the step is halved.
const HALVINGS: u32 = 6;
/// Gain below which the refinement fits noise of the few small samples, dB: the frame stays as computed.
const REFINED_GAIN_DB: f64 = 1.0;

/// What a search tries and measures with.
pub(super) struct Search<'a> {
    /// Mean PSNR of the samples with corrections, dB; the first applies first.
    pub(super) psnr_db: &'a dyn Fn(&[Mistake]) -> Result<f64, CheckError>,
    /// Similarities of which there is reason to think.
    pub(super) frames: &'a [FrameCandidate],
    /// PSNR that explains the photos, dB.
    pub(super) enough_db: f64,
    /// Point about which the refinement rotates, splat's world.
    pub(super) centre: DVec3,
    /// Size of the scene, splat's units.
    pub(super) scene_diagonal: f64,
}

impl Search<'_> {
    /// Tries single corrections, then pairs, then a sweep of scales, until one explains the photos. Returns all trials,
    /// best first; a similarity among the best is refined.
    pub(super) fn run(&self) -> Result<Vec<Trial>, CheckError> {
        let frames = self.frames.iter().map(|frame| Mistake::Frame(*frame));
        let worlds: Vec<Mistake> = frames
            .chain(single_mistakes().into_iter().filter(|m| matches!(m, Mistake::WorldAxes(_))))
            .collect();
        let singles = single_mistakes().into_iter().filter(|m| !matches!(m, Mistake::WorldAxes(_)));
        let mut tried = Vec::new();
        for mistake in singles.chain(worlds.iter().copied()) {
            self.try_one(mistake, None, &mut tried)?;
        }
        if !self.explains(&tried) {
            for camera in CAMERA_CONVENTIONS {
                for world in &worlds {
                    self.try_one(camera, Some(*world), &mut tried)?;
                }
            }
        }
        if !self.explains(&tried) {
            let n = (SWEEP_LIMIT.ln() / SWEEP_STEP.ln()).floor() as i32;
            let mut best: Option<Trial> = None;
            for power in (-n..=n).filter(|power| *power != 0) {
                let mistake = Mistake::SceneScale(SWEEP_STEP.powi(power));
                let psnr_db = (self.psnr_db)(&[mistake])?;
                if best.is_none_or(|best| psnr_db > best.psnr_db) {
                    best = Some(Trial { mistake, and: None, psnr_db });
                }
            }
            if let Some(best) = best {
                tried.push(self.refined_scale(best)?);
            }
        }
        sort(&mut tried);
        if let Some(first) = tried.first_mut() {
            *first = self.refined(*first)?;
        }
        Ok(tried)
    }

    fn try_one(
        &self,
        mistake: Mistake,
        and: Option<Mistake>,
        tried: &mut Vec<Trial>,
    ) -> Result<(), CheckError> {
        let trial = Trial { mistake, and, psnr_db: 0.0 };
        tried.push(Trial { psnr_db: (self.psnr_db)(&trial.corrections())?, ..trial });
        Ok(())
    }

    fn explains(&self, tried: &[Trial]) -> bool {
        tried.iter().any(|trial| trial.psnr_db > self.enough_db)
    }

    /// Halves the interval between scales of the sweep around the best one.
    fn refined_scale(&self, mut best: Trial) -> Result<Trial, CheckError> {
        let mut step = SWEEP_STEP.sqrt();
        for _ in 0..HALVINGS + 2 {
            let Mistake::SceneScale(scale) = best.mistake else { break };
            for mistake in [scale * step, scale / step].map(Mistake::SceneScale) {
                let psnr_db = (self.psnr_db)(&[mistake])?;
                if psnr_db > best.psnr_db {
                    best = Trial { mistake, and: None, psnr_db };
                }
            }
            step = step.sqrt();
        }
        Ok(best)
    }

    /// Moves a frame that is computed from other data than the trainer's to where the drawings match best (pattern
    /// search, Hooke and Jeeves 1961). Others are exact.
    fn refined(&self, best: Trial) -> Result<Trial, CheckError> {
        let Mistake::Frame(FrameCandidate { cause: FrameCause::NerfstudioDefaults, splat_from_poses }) =
            best.mistake
        else {
            return Ok(best);
        };
        let with = |splat_from_poses| {
            let cause = FrameCause::NerfstudioDefaults;
            Trial { mistake: Mistake::Frame(FrameCandidate { cause, splat_from_poses }), ..best }
        };
        let (mut similarity, mut psnr_db) = (splat_from_poses, best.psnr_db);
        let mut step = FIRST_STEP;
        for _ in 0..=HALVINGS {
            for direction in 0..14 {
                let moved = self.moved(similarity, direction, step);
                let found_db = (self.psnr_db)(&with(moved).corrections())?;
                if found_db > psnr_db {
                    (similarity, psnr_db) = (moved, found_db);
                }
            }
            step *= 0.5;
        }
        let is_clear = psnr_db > best.psnr_db + REFINED_GAIN_DB;
        Ok(if is_clear { Trial { psnr_db, ..with(similarity) } } else { best })
    }

    /// Returns a similarity moved a step in one of 14 directions: scale, three rotations and three translations, up and
    /// down.
    fn moved(&self, similarity: Similarity, direction: usize, step: f64) -> Similarity {
        let step = if direction.is_multiple_of(2) { step } else { -step };
        let axis = |at: usize| DVec3::from_array(std::array::from_fn(|i| if i == at { 1.0 } else { 0.0 }));
        let mut change = Similarity::IDENTITY;
        match direction / 2 {
            0 => change.scale = step.exp(),
            at @ 1..=3 => change.rotation = DQuat::from_axis_angle(axis(at - 1), step),
            at => change.translation = axis(at - 4) * (step * self.scene_diagonal),
        }
        // About the centre of the scene, not the origin.
        change.translation += self.centre - change.rotation * self.centre * change.scale;
        change.after(&similarity)
    }
}

/// Sorts trials, best first; equals stay in their order.
fn sort(tried: &mut [Trial]) {
    tried.sort_by(|a, b| b.psnr_db.total_cmp(&a.psnr_db));
}
