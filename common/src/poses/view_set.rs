//! The views of a scene.

use std::path::Path;

use glam::DAffine3;

use super::error::{Place, PoseError, PoseProblem};
use crate::camera::View;

/// The views of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSet {
    /// Sorted by name; names are unique.
    pub views: Vec<View>,
    /// The format they were read from.
    pub source: PoseSource,
    /// Names of frames that are listed without a pose (ScanNet's `-inf`), sorted; they are not in `views`.
    pub without_pose: Vec<String>,
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

/// A format of poses.
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

/// Sorts views by name; an empty set or two equal names are errors.
pub(super) fn view_set(path: &Path, mut views: Vec<View>, source: PoseSource) -> Result<ViewSet, PoseError> {
    if views.is_empty() {
        return Err(PoseProblem::NoViews.at(path, Place::File));
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(PoseProblem::DuplicateImage { image: pair[0].name.clone() }.at(path, Place::File));
    }
    Ok(ViewSet { views, source, without_pose: Vec::new(), applied: None })
}
