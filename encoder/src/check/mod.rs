//! Checks that photos, poses and scene belong together, before any expensive work.
//!
//! The check draws sample views of the scene, compares each with its photo and, where they differ, looks for common
//! mistakes in poses and intrinsics.

mod align;
mod diagnosis;
mod error;
mod frames;
mod mistake;
mod report;
mod search;
#[cfg(test)]
mod tests;
mod trial;
mod view;

use std::path::PathBuf;

use slag_common::Gaussians;

use crate::ingest::IngestError;
use crate::raster::Rasterizer;
use diagnosis::{CLEAR_GAIN_DB, Samples};
use view::{at_width, draw, flat_psnr_db, mean, picture, picture_name};

pub use align::{AlignError, Alignment, align};
pub use diagnosis::Diagnosis;
pub use error::CheckError;
pub use frames::{FrameCandidate, FrameCause, nerfstudio_defaults};
pub use mistake::Mistake;
pub use report::{CheckReport, ViewCheck};
pub use trial::Trial;
pub use view::{CheckView, psnr_db};

/// Settings of a check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckOptions {
    /// Width at which views are compared, pixels. Photos are never enlarged.
    pub width_px: u32,
    /// Folder for a picture of each view (photo left, drawing right); `None` writes no pictures.
    pub pictures_dir: Option<PathBuf>,
    /// Width of the views in which mistakes are searched, pixels.
    pub diagnosis_width_px: u32,
    /// Number of views in which mistakes are searched, spread evenly over all views.
    pub diagnosis_views: usize,
    /// Similarities between the worlds of poses and splat that are tried beside common mistakes.
    pub frames: Vec<FrameCandidate>,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self {
            width_px: 800,
            pictures_dir: None,
            diagnosis_width_px: 240,
            diagnosis_views: 4,
            frames: Vec::new(),
        }
    }
}

/// Draws the views of a scene and compares them with their photos.
///
/// Views are taken one at a time, so that one photo is in memory, plus `diagnosis_views` small copies.
///
/// # Errors
/// [`CheckError`] if a photo cannot be loaded, a view cannot be drawn or a picture cannot be written. A scene that
/// does not fit its photos is no error; the report then has a [`Diagnosis`].
pub fn check<V>(
    scene: &Gaussians,
    views: V,
    rasterizer: &dyn Rasterizer,
    options: &CheckOptions,
) -> Result<CheckReport, CheckError>
where
    V: IntoIterator<Item = Result<CheckView, IngestError>, IntoIter: ExactSizeIterator>,
{
    let views = views.into_iter();
    let n_views = views.len();
    if n_views == 0 {
        return Err(CheckError::NoViews);
    }
    if let Some(dir) = &options.pictures_dir {
        fs_err::create_dir_all(dir)?;
    }
    let mut checks = Vec::with_capacity(n_views);
    let mut unusable_gaussians = 0;
    let mut samples = Samples::new(n_views, options.diagnosis_views, options.diagnosis_width_px);
    for (index, view) in views.enumerate() {
        let view = view?;
        let small = at_width(&view, options.width_px)?;
        let drawing = draw(scene, &small, rasterizer)?;
        unusable_gaussians = unusable_gaussians.max(drawing.counters.unusable);
        if let Some(dir) = &options.pictures_dir {
            fs_err::write(dir.join(picture_name(index, &view.name)), picture(&small, &drawing)?)?;
        }
        checks.push(ViewCheck {
            name: view.name.clone(),
            psnr_db: psnr_db(&small.image, |pixel, c| drawing.rgb[pixel * 3 + c]),
            flat_psnr_db: flat_psnr_db(&small.image),
            covered_share: mean(drawing.coverage.iter().map(|&alpha| f64::from(u8::from(alpha > 0.5)))),
            visible_gaussians: drawing.counters.visible,
        });
        samples.add(index, &view)?;
    }
    let mut report = CheckReport {
        mean_psnr_db: mean(checks.iter().map(|c| c.psnr_db)),
        mean_flat_psnr_db: mean(checks.iter().map(|c| c.flat_psnr_db)),
        mean_covered_share: mean(checks.iter().map(|c| c.covered_share)),
        views: checks,
        unusable_gaussians,
        notes: Vec::new(),
        diagnosis: None,
    };
    if report.mean_psnr_db < report.mean_flat_psnr_db + CLEAR_GAIN_DB {
        report.diagnosis = Some(samples.diagnose(scene, rasterizer, report.means(), &options.frames)?);
    }
    Ok(report)
}
