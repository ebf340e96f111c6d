//! The models that a store was encoded with, as this machine knows them.
//!
//! They are not part of the manifest or its extras: a folder of this machine means nothing to robots, and must not
//! change what is published.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use slag_common::Hash32;

const FILE: &str = "models.json";

/// The models of the last encode into a store.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ModelsRecord {
    /// The encoder's id, as the manifest has it.
    pub(crate) encoder: Hash32,
    /// Name or folder of the models; `None` for the embedded ones.
    pub(crate) models: Option<PathBuf>,
}

impl ModelsRecord {
    pub(super) fn path(dir: &Path) -> PathBuf {
        dir.join(FILE)
    }

    /// Reads the record. An unreadable one counts as absent: the user can still name the models.
    pub(super) fn read(dir: &Path) -> io::Result<Option<Self>> {
        match fs_err::read(Self::path(dir)) {
            Ok(bytes) => Ok(serde_json::from_slice(&bytes).ok()),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(e),
        }
    }
}
