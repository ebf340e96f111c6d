//! `models.lock`: what was accepted when a model was pulled first, so that later pulls are the same.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::error::HubError;
use super::source::Source;
use crate::description::Sha256;

/// What was accepted, by model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Lock {
    models: BTreeMap<String, Accepted>,
}

/// What was accepted of a model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Accepted {
    /// The licence.
    pub licence: String,
    /// The commit.
    pub revision: Option<String>,
    /// Files, by path.
    pub files: BTreeMap<String, LockedFile>,
}

/// A file that was accepted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LockedFile {
    /// Its SHA-256.
    pub sha256: Sha256,
    /// Whose word that is.
    pub on_the_word_of: Source,
}

impl LockedFile {
    /// Says that a file is not this one.
    pub(super) fn refusal(self, path: PathBuf, found: Sha256, advice: &'static str) -> HubError {
        HubError::Hash { path, found, expected: self.sha256, by: self.on_the_word_of, advice }
    }
}

/// The lock's place below the folder of models.
fn path_in(root: &Path) -> PathBuf {
    root.join("models.lock")
}

impl Lock {
    /// Reads the lock of the folder of models; an empty one where there is none.
    /// # Errors
    /// [`HubError`] where it cannot be read.
    pub fn read(root: &Path) -> Result<Self, HubError> {
        let path = path_in(root);
        match fs_err::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|cause| HubError::Lock { path, cause }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes the lock, whole or not at all.
    pub(super) fn write(&self, root: &Path) -> Result<(), HubError> {
        let text = serde_json::to_vec_pretty(self).map_err(io::Error::from)?;
        Ok(slag_common::durable::write(&path_in(root), &text)?)
    }

    /// Returns what was accepted of a model.
    pub fn get(&self, name: &str) -> Option<&Accepted> {
        self.models.get(name)
    }

    /// Returns what was accepted of a model, to be changed.
    pub(super) fn entry(&mut self, name: &str) -> &mut Accepted {
        self.models.entry(name.to_owned()).or_default()
    }
}
