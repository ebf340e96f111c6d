//! The views of a scene.

use std::path::Path;

use glam::DAffine3;

use super::error::{Place, PoseError, PoseProblem};
use crate::camera::View;

#[derive(Clone, Debug, PartialEq)]
pub struct ViewSet {
    /// Sorted by name; names are unique.
    pub views: Vec<View>,
    pub source: PoseSource,
    /// Sorted names of frames listed without a pose (ScanNet's `-inf`); they are not in `views`.
    pub without_pose: Vec<String>,
    /// Frames left out because their pose is invalid, each with the reason.
    pub damaged: Vec<(String, String)>,
    /// What was guessed or chosen while reading, one sentence each.
    pub notes: Vec<String>,
    /// The transform that `transforms.json` states as applied to its poses.
    pub applied: Option<AppliedTransform>,
}

/// A change of the world frame by nerfstudio's `ns-process-data`: `saved = scale * transform * original`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AppliedTransform {
    /// `applied_transform`: a rotation and a translation.
    pub transform: DAffine3,
    /// `applied_scale`.
    pub scale: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// COLMAP `cameras.txt` and `images.txt`.
    ColmapText,
    /// COLMAP `cameras.bin` and `images.bin`.
    ColmapBinary,
    /// Nerfstudio `transforms.json`.
    Transforms,
    /// A folder of ScanNet's SensReader.
    Scannet,
}

impl ViewSet {
    /// Returns a sentence on the omitted frames, if there are any.
    pub fn left_out(&self) -> Option<String> {
        let (lost, damaged) = (self.without_pose.len(), self.damaged.len());
        let of = self.views.len() + lost + damaged;
        let first = self.damaged.first().map(|(name, reason)| format!("{name} ({reason})"));
        let first = first.or_else(|| self.without_pose.first().cloned())?;
        Some(format!("{} of {of} frames have no pose and are left out, the first is {first}", lost + damaged))
    }
}

/// Omitted frames, and the problem of the first.
#[derive(Default)]
pub(super) struct Damaged {
    frames: Vec<(String, String)>,
    first: Option<PoseError>,
}

impl Damaged {
    /// Adds a frame with a pose problem; if no frame remains, the first problem is reported as the file's.
    pub(super) fn add(&mut self, frame: &str, problem: PoseProblem, path: &Path, place: Place) {
        self.frames.push((frame.to_owned(), problem.fault.clone()));
        let fault = format!("{frame:?}: {}", problem.fault);
        self.first.get_or_insert_with(|| PoseProblem { fault, ..problem }.at(path, place));
    }

    /// Adds a frame without a pose, as programs write it for photos that they could not place.
    pub(super) fn add_unplaced(&mut self, frame: &str, reason: String) {
        self.frames.push((frame.to_owned(), reason));
    }
}

/// Sorts views by name; an empty set and equal names are errors.
pub(super) fn view_set(
    path: &Path,
    mut views: Vec<View>,
    source: PoseSource,
    damaged: Damaged,
) -> Result<ViewSet, PoseError> {
    let fail = |fault: &str, advice| PoseProblem::new(fault, advice).at(path, Place::File);
    if views.is_empty() {
        let none = || fail("the file has no posed images", "check that the reconstruction succeeded");
        return Err(damaged.first.unwrap_or_else(none));
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let fault = format!("two images have the name {:?}", pair[0].name);
        return Err(fail(&fault, "remove or rename one of them"));
    }
    let (without_pose, notes) = Default::default();
    Ok(ViewSet { views, source, without_pose, damaged: damaged.frames, notes, applied: None })
}
