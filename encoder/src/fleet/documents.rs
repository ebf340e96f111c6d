//! The JSON documents in a bucket, and the keys of all objects.

use glam::DAffine3;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use slag_common::{Hash32, Intrinsics};

use super::damaged;
use crate::blobs::Bucket;
use crate::cells::CellLimits;
use crate::encode::{EncodeError, ViewSettings};

const FORMAT: u32 = 4;

pub(super) fn own_version() -> String {
    format!("{}, fleet format {FORMAT}", env!("CARGO_PKG_VERSION"))
}

/// Read first: the rest of a plan may differ between versions.
#[derive(Deserialize)]
pub(super) struct PlannedBy {
    pub(super) program: String,
}

/// An input file: its content's hash, and its ending.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct InputFile {
    pub(super) hash: Hash32,
    pub(super) ending: String,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct PlannedView {
    pub(super) name: String,
    pub(super) id: Hash32,
    pub(super) photo: InputFile,
    /// Its mask file, where masks are given as a folder.
    pub(super) masks: Option<InputFile>,
    pub(super) intrinsics: Intrinsics,
    pub(super) camera_from_world: DAffine3,
}

/// `jobs/N/plan.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RunPlan {
    pub(super) program: String,
    /// A random number, by which a coordinator knows its own plan again.
    pub(super) coordinator: u64,
    /// Models and segmenter, for messages.
    pub(super) engines: String,
    /// Hash of everything on which the contributions of all views depend.
    pub(super) of_scene: Hash32,
    /// The scene's object among the inputs.
    pub(super) scene: Hash32,
    pub(super) settings: ViewSettings,
    pub(super) limits: CellLimits,
    /// The data set of masks, where they are given as one file.
    pub(super) data_set: Option<InputFile>,
    /// The views to do, costly ones first.
    pub(super) views: Vec<PlannedView>,
}

/// `jobs/N/failed/VIEW.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct FailedView {
    pub(super) reason: String,
}

/// `jobs/N/end.json`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum End {
    Published,
    /// Another coordinator began the next run.
    Superseded,
}

pub(super) fn input_key(hash: Hash32) -> String {
    format!("inputs/{hash}")
}

pub(super) fn view_key(id: Hash32) -> String {
    format!("views/{id}")
}

pub(super) fn parse<T: DeserializeOwned>(bucket: &Bucket, key: &str, bytes: &[u8]) -> Result<T, EncodeError> {
    serde_json::from_slice(bytes).map_err(|e| damaged(bucket, key, e))
}

pub(super) fn to_bytes(document: &impl Serialize) -> Result<Vec<u8>, EncodeError> {
    Ok(serde_json::to_vec(document).map_err(std::io::Error::from)?)
}
