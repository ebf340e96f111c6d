//! `models.lock`: hashes accepted in a model's first pull, so that later pulls give the same files.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::{HubError, Source};
use crate::description::Sha256;

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Lock {
    models: BTreeMap<String, Accepted>,
}

/// The accepted licence, commit and files of a model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accepted {
    pub licence: String,
    pub revision: Option<String>,
    pub files: BTreeMap<String, LockedFile>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LockedFile {
    pub sha256: Sha256,
    pub hash_source: Source,
}

impl LockedFile {
    /// The error for a file with another hash.
    pub(super) fn refusal(&self, path: &Path, found: Sha256, advice: &str) -> HubError {
        let (path, Self { sha256, hash_source }) = (path.display(), self);
        HubError::Other(format!("{path}: SHA-256 is {found}, expected {sha256} ({hash_source}); {advice}"))
    }
}

fn path_in(root: &Path) -> PathBuf {
    root.join("models.lock")
}

impl Lock {
    /// Reads the lock; empty if there is none.
    pub fn read(root: &Path) -> Result<Self, HubError> {
        let path = path_in(root);
        match fs_err::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|cause| {
                let path = path.display();
                HubError::Other(format!("{path}: {cause}; correct it, or remove it and pull again"))
            }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes the lock atomically.
    pub(super) fn write(&self, root: &Path) -> Result<(), HubError> {
        let text = serde_json::to_vec_pretty(self).map_err(io::Error::from)?;
        Ok(slag_common::durable::write(&path_in(root), &text)?)
    }

    pub fn get(&self, name: &str) -> Option<&Accepted> {
        self.models.get(name)
    }

    pub(super) fn entry(&mut self, name: &str) -> &mut Accepted {
        self.models.entry(name.to_owned()).or_default()
    }
}
