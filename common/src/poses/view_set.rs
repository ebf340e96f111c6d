//! The views of a scene.

use std::path::Path;

use super::error::{Place, PoseError, PoseProblem};
use crate::camera::View;

/// The views of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSet {
    /// Sorted by name; names are unique.
    pub views: Vec<View>,
    /// The format they were read from.
    pub source: PoseSource,
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
    Ok(ViewSet { views, source })
}
