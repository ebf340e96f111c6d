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
    /// Names of frames that are listed without a pose (ScanNet's `-inf`), sorted; they are not in `views`.
    pub without_pose: Vec<String>,
    /// Frames that are left out because their pose is no rotation and translation, with the reason.
    pub damaged: Vec<(String, String)>,
    /// What was guessed or chosen while reading, a sentence each.
    pub notes: Vec<String>,
    /// The transform that `transforms.json` states was applied to its poses already.
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
    /// Returns a sentence on the frames that are left out, if there are any.
    pub fn left_out(&self) -> Option<String> {
        let (lost, damaged) = (self.without_pose.len(), self.damaged.len());
        let of = self.views.len() + lost + damaged;
        let first = self.damaged.first().map(|(name, reason)| format!("{name} ({reason})"));
        let first = first.or_else(|| self.without_pose.first().cloned())?;
        Some(format!("{} of {of} frames have no pose and are left out, the first is {first}", lost + damaged))
    }
}

/// Frames that are left out, and what is wrong with the first of them.
#[derive(Default)]
pub(super) struct Damaged {
    frames: Vec<(String, String)>,
    first: Option<PoseError>,
}

impl Damaged {
    /// Adds a frame whose pose has a problem; where no frame is left, the first of them is the file's.
    pub(super) fn add(&mut self, frame: &str, problem: PoseProblem, path: &Path, place: Place) {
        self.frames.push((frame.to_owned(), problem.of_pose()));
        self.first.get_or_insert_with(|| problem.at(path, place));
    }

    /// Adds a frame without a pose, as programs write it that could not place the photo.
    pub(super) fn add_unplaced(&mut self, frame: &str, reason: String) {
        self.frames.push((frame.to_owned(), reason));
    }
}

/// Sorts views by name; an empty set or two equal names are errors.
pub(super) fn view_set(
    path: &Path,
    mut views: Vec<View>,
    source: PoseSource,
    damaged: Damaged,
) -> Result<ViewSet, PoseError> {
    if views.is_empty() {
        return Err(damaged.first.unwrap_or_else(|| PoseProblem::NoViews.at(path, Place::File)));
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(PoseProblem::DuplicateImage { image: pair[0].name.clone() }.at(path, Place::File));
    }
    let (without_pose, notes) = Default::default();
    Ok(ViewSet { views, source, without_pose, damaged: damaged.frames, notes, applied: None })
}
