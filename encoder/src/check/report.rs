//! What a check is asked, its report as a table or as JSON, and why it fails.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

use super::diagnosis::Diagnosis;
use super::mistake::FrameCandidate;
use super::suspicion::Suspicion;
use crate::ingest::IngestError;
use crate::raster::RasterError;

/// A drawing with this PSNR looks much like its photo.
const ALIKE_DB: f64 = 25.0;

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
}

impl ViewCheck {
    /// Returns whether the drawing looks more like the photo than its mean colour does, or much like it: of a bare wall
    /// the mean colour is hard to surpass.
    pub fn fits(&self) -> bool {
        self.psnr_db >= self.flat_psnr_db.min(ALIKE_DB)
    }
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

#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    #[error("no views to check; give at least one photo with its pose")]
    NoViews,
    #[error("none of the {n_views} sampled photos can be read, the first: {first}")]
    NoPhotos { n_views: usize, first: IngestError },
    #[error(
        "view {view}: the photo has {} x {} px but its camera {} x {} px; give the photo that the camera describes",
        image_px[0], image_px[1], camera_px[0], camera_px[1]
    )]
    ImageSize { view: String, image_px: [u32; 2], camera_px: [u32; 2] },
    #[error("view {view}: {source}")]
    Raster { view: String, source: RasterError },
    #[error(transparent)]
    Scene(#[from] RasterError),
    #[error("view {view}: cannot encode its picture ({source}); choose a smaller width")]
    Encode { view: String, source: image::ImageError },
    #[error("{0}; choose another folder for the pictures")]
    Write(#[from] std::io::Error),
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a bare wall drawn well, another place drawn, and a black photo, whose own colour is exact.
    #[test]
    fn a_view_fits_unless_a_plain_colour_is_clearly_more_like_the_photo() {
        let fits = |psnr_db, flat_psnr_db| {
            let (covered_share, visible_gaussians) = (1.0, 1);
            let name = String::new();
            ViewCheck { name, psnr_db, flat_psnr_db, covered_share, visible_gaussians }.fits()
        };
        assert!(fits(31.0, 40.0) && fits(18.0, 14.0));
        assert!(!fits(11.0, 14.0) && !fits(5.0, f64::INFINITY));
    }
}
