//! How to check.

use std::path::PathBuf;

use super::mistake::FrameCandidate;
use super::suspicion::Suspicion;

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
