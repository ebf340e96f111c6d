//! Finds the mistake that explains why drawings and photos differ.

use glam::DVec3;
use serde::Serialize;
use slag_common::{Gaussians, Similarity};
use slag_math::stats::{Rank, quantile};

use super::error::CheckError;
use super::frames::FrameCandidate;
use super::mistake::Mistake;
use super::search::Search;
use super::trial::Trial;
use super::view::{CheckView, at_width, draw, flat_psnr_db, mean, psnr_db};
use crate::raster::Rasterizer;

/// Result of the search for a mistake.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// PSNR of the sampled views with the poses as given, dB.
    pub given_psnr_db: f64,
    /// The mistake whose correction explains the photos, if any does.
    pub mistake: Option<Mistake>,
    /// A second mistake, corrected after the first.
    pub and: Option<Mistake>,
    /// The similarity from the world of the poses to that of the splat, where the mistake is one and nothing else.
    pub splat_from_poses: Option<Similarity>,
    /// All corrections tried, best first.
    pub tried: Vec<Trial>,
    /// Diagonal of the box around the middle 90 % of the Gaussians along each axis, world units.
    pub scene_diagonal: f64,
    /// Largest distance of a camera from the cameras' mean position, world units.
    pub camera_spread: f64,
    /// The findings as sentences.
    pub advice: Vec<String>,
}

/// Least gain that counts as clear, both of a correction over the given poses and of a drawing over a plain colour, dB.
pub(super) const CLEAR_GAIN_DB: f64 = 3.0;

/// Means over all views of a check.
#[derive(Clone, Copy, Debug)]
pub(super) struct Means {
    /// PSNR of the drawings, dB.
    pub(super) psnr_db: f64,
    /// PSNR of a plane of each photo's mean colour, dB.
    pub(super) flat_psnr_db: f64,
    /// Share of the images that the scene covers.
    pub(super) covered_share: f64,
}

/// Small copies of some views, and the positions of all cameras.
pub(super) struct Samples {
    /// Indices of the sampled views, ascending.
    indices: Vec<usize>,
    width_px: u32,
    views: Vec<CheckView>,
    camera_positions: Vec<DVec3>,
}

impl Samples {
    /// Chooses `n_samples` of `n_views` views, evenly spread.
    pub(super) fn new(n_views: usize, n_samples: usize, width_px: u32) -> Self {
        let n = n_samples.clamp(1, n_views);
        let indices = (0..n).map(|i| i * n_views / n).collect();
        Self {
            indices,
            width_px,
            views: Vec::with_capacity(n),
            camera_positions: Vec::with_capacity(n_views),
        }
    }

    /// Adds the view with this index; its photo is copied only if the view is a sample.
    pub(super) fn add(&mut self, index: usize, view: &CheckView) -> Result<(), CheckError> {
        self.camera_positions.push(view.view.camera_from_world.inverse().translation);
        if self.indices.binary_search(&index).is_ok() {
            self.views.push(at_width(view, self.width_px)?);
        }
        Ok(())
    }

    /// Searches for the correction with which the samples match; `frames` are tried beside common mistakes.
    pub(super) fn diagnose(
        &self,
        scene: &Gaussians,
        rasterizer: &dyn Rasterizer,
        means: Means,
        frames: &[FrameCandidate],
    ) -> Result<Diagnosis, CheckError> {
        let psnr_with = |corrections: &[Mistake]| -> Result<f64, CheckError> {
            let mut sum = 0.0;
            for sample in &self.views {
                let view = corrections.iter().fold(sample.view, |view, mistake| mistake.corrected(&view));
                let drawing = draw(scene, &CheckView { view, ..sample.clone() }, rasterizer)?;
                sum += psnr_db(&sample.image, |pixel, c| drawing.rgb[pixel * 3 + c]);
            }
            Ok(sum / self.views.len() as f64)
        };
        let given_psnr_db = psnr_with(&[])?;
        // A correction that merely turns black into some colour gains too, but never exceeds the mean colour.
        let flat_db = mean(self.views.iter().map(|sample| flat_psnr_db(&sample.image)));
        let enough_db = (given_psnr_db + CLEAR_GAIN_DB).max(flat_db);
        let scene_diagonal = scene_diagonal(scene);
        let centre = scene_middle(scene);
        let tried = Search { psnr_db: &psnr_with, frames, enough_db, centre, scene_diagonal }.run()?;
        let best = tried.first().filter(|best| best.psnr_db > enough_db);
        let mut diagnosis = Diagnosis {
            given_psnr_db,
            mistake: best.map(|best| best.mistake),
            and: best.and_then(|best| best.and),
            splat_from_poses: best
                .filter(|best| best.and.is_none())
                .and_then(|best| best.mistake.splat_from_poses()),
            tried,
            scene_diagonal,
            camera_spread: spread(&self.camera_positions),
            advice: Vec::new(),
        };
        diagnosis.advice = advice(&diagnosis, means);
        Ok(diagnosis)
    }
}

fn advice(diagnosis: &Diagnosis, means: Means) -> Vec<String> {
    let mut advice = Vec::new();
    match diagnosis.mistake {
        Some(mistake) => {
            let and = diagnosis.and.map_or(String::new(), |and| format!("; and {and}"));
            advice.push(format!(
                "{mistake}{and} (PSNR {:.1} dB instead of {:.1} dB)",
                diagnosis.tried[0].psnr_db, diagnosis.given_psnr_db
            ));
        }
        None => advice.push(format!(
            "the drawings match the photos hardly better than a plain colour (PSNR {:.1} dB, plain colour {:.1} dB), \
             and no common mistake explains it; check that photos, poses and scene come from the same reconstruction",
            means.psnr_db, means.flat_psnr_db
        )),
    }
    if diagnosis.mistake.is_none() && means.covered_share < 0.5 {
        advice.push(format!(
            "the scene covers {:.0} % of the images; the cameras look away from it or are far from it",
            means.covered_share * 100.0
        ));
    }
    let Diagnosis { scene_diagonal, camera_spread, .. } = *diagnosis;
    if camera_spread > 0.0 && !(0.05..=200.0).contains(&(scene_diagonal / camera_spread)) {
        advice.push(format!(
            "the scene measures {scene_diagonal:.3} and the cameras spread over {camera_spread:.3}; \
             check that both have the same unit"
        ));
    }
    advice
}

/// Returns the diagonal of the box around the middle 90 % of the means along each axis.
fn scene_diagonal(scene: &Gaussians) -> f64 {
    (at_per_mille(scene, 950) - at_per_mille(scene, 50)).length()
}

/// Returns the medians of the means along the axes.
fn scene_middle(scene: &Gaussians) -> DVec3 {
    at_per_mille(scene, 500)
}

fn at_per_mille(scene: &Gaussians, per_mille: usize) -> DVec3 {
    let along = |axis: usize| {
        let finite = |p: &DVec3| Some(p[axis]).filter(|v| v.is_finite());
        let mut values: Vec<f64> = scene.means_in_world.iter().filter_map(finite).collect();
        quantile(&mut values, per_mille, Rank::Between).unwrap_or_default()
    };
    DVec3::new(along(0), along(1), along(2))
}

/// Returns the largest distance of a position from the mean of all positions.
fn spread(positions: &[DVec3]) -> f64 {
    let centre = positions.iter().sum::<DVec3>() / positions.len() as f64;
    positions.iter().map(|p| p.distance(centre)).fold(0.0, f64::max)
}
