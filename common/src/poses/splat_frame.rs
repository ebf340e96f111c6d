//! The frame of a splat trained in another frame than its poses': nerfstudio's `dataparser_transforms.json`.
//!
//! `ns-train` changes the world of its input poses and writes the change into the run's folder: `trained = scale *
//! (transform * original)`. `ns-export gaussian-splat` uses the trained frame. `original` depends on the dataparser
//! (nerfstudio 1.1, `data/dataparsers/`):
//!
//! | poses | `original` |
//! |---|---|
//! | COLMAP | COLMAP's world |
//! | `transforms.json` | the world before its `applied_transform` and `applied_scale` |
//! | ScanNet | ScanNet's world with x and y swapped and z negated, which the file does not mention |
//!
//! The ScanNet dataparser never rotates further, so a file with a rotation is from another dataparser and begins at
//! the poses themselves.

use std::fmt;
use std::io::Read;
use std::path::Path;

use glam::{DAffine3, DMat3, DQuat};
use serde::{Deserialize, Serialize};

use super::checks::affine_from_rows;
use super::error::{Place, PoseError, PoseProblem};
use super::transforms::COLMAP_AXES;
use super::view_set::{AppliedTransform, PoseSource};
use crate::files;
use crate::similarity::Similarity;

pub const FRAME_FILE: &str = "dataparser_transforms.json";
/// Value of `from` in files of [`SplatFrame::to_json`].
const FROM_POSES: &str = "poses";
/// Largest size of a file: 13 numbers and their names.
const MAX_BYTES: u64 = 65_536;

/// Contents of a `dataparser_transforms.json`: the similarity between the frames of the poses and of the splat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatFrame {
    transform: DAffine3,
    scale: f64,
    from_poses: bool,
}

crate::named_members!(Json; Serialize);

#[derive(Serialize, Deserialize)]
#[serde(remote = "Self")]
struct Json {
    transform: Vec<Vec<f64>>,
    scale: f64,
    /// Ours: `poses` where the transform begins at the poses as read. Nerfstudio ignores it.
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<String>,
}

impl SplatFrame {
    pub fn read(path: &Path) -> Result<Self, PoseError> {
        let mut bytes = Vec::new();
        files::open(path)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
        let fail = |problem: PoseProblem| problem.at(path, Place::File);
        if bytes.len() as u64 > MAX_BYTES {
            let bytes = files::metadata(path)?.len();
            return Err(fail(PoseProblem::too_large(bytes, MAX_BYTES, FRAME_FILE)));
        }
        let text = files::text_of(&bytes).map_err(|fault| fail(fault.into()))?;
        let json: Json = serde_json::from_str(text).map_err(|cause| {
            let advice = "remove the file, or name another with --splat-frame";
            let expected = "expected nerfstudio's transform (3 x 4) and scale";
            PoseError::of(path, format_args!("{cause}; {expected}; {advice}"))
        })?;
        // A larger factor is no change of unit, and squared lengths would exceed f32.
        if !(1e-9..=1e9).contains(&json.scale) {
            return Err(fail(PoseProblem::expected("a scale from 1e-9 to 1e9", json.scale)));
        }
        let transform = affine_from_rows(&json.transform, DMat3::IDENTITY).map_err(fail)?;
        Ok(Self { transform, scale: json.scale, from_poses: json.from.as_deref() == Some(FROM_POSES) })
    }

    /// Returns a file's text for `splat_from_poses`, in nerfstudio's format.
    pub fn to_json(splat_from_poses: &Similarity) -> String {
        let Similarity { scale, rotation, translation } = *splat_from_poses;
        let rotation = DMat3::from_quat(rotation);
        let translation = translation / scale;
        let row = |axis: usize| {
            let row = rotation.row(axis);
            vec![row.x, row.y, row.z, translation[axis]]
        };
        let json = Json { transform: (0..3).map(row).collect(), scale, from: Some(FROM_POSES.to_owned()) };
        // Numbers and texts always serialise.
        serde_json::to_string_pretty(&json).unwrap_or_default() + "\n"
    }

    /// Transform from the poses' world to the splat's; for `source` and `applied` see [`ViewSet`](super::ViewSet).
    pub fn splat_from_poses(&self, source: PoseSource, applied: Option<AppliedTransform>) -> SplatFromPoses {
        let direct = |scale| Similarity::from_rigid_then_scale(self.transform, scale);
        let (similarity, begins_at) = match (self.from_poses, source, applied) {
            (false, PoseSource::Transforms, Some(applied)) => {
                let transform = self.transform * applied.transform.inverse();
                let similarity = Similarity::from_rigid_then_scale(transform, self.scale / applied.scale);
                (similarity, Origin::BeforeAppliedTransform)
            }
            (false, PoseSource::Scannet, _) if direct(1.0).is_unrotated() => {
                let axes = Similarity::from_rotation(DQuat::from_mat3(&COLMAP_AXES));
                (direct(self.scale).after(&axes), Origin::ScannetDataparser)
            }
            _ => (direct(self.scale), Origin::Poses),
        };
        SplatFromPoses { similarity, begins_at }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatFromPoses {
    pub similarity: Similarity,
    pub begins_at: Origin,
}

/// The frame where a file's transform begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The poses as read.
    Poses,
    /// The world before the `applied_transform` of the `transforms.json`.
    BeforeAppliedTransform,
    /// The axes of nerfstudio's ScanNet dataparser.
    ScannetDataparser,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Poses => "the poses as they are",
            Self::BeforeAppliedTransform => "the world before the applied_transform of transforms.json",
            Self::ScannetDataparser => {
                "the axes of nerfstudio's ScanNet dataparser (x and y swapped, z negated)"
            }
        })
    }
}
