//! Errors of the cache.

use std::io;
use std::path::{Path, PathBuf};

use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::ManifestError;
use slag_common::shard::Profile;

use super::files::is_bad_medium;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("{0}; check the cache's folder and its permissions")]
    Io(io::Error),
    #[error("{0}; fetch again, which replaces it")]
    Unreadable(io::Error),
    #[error("{path} holds no scene yet; fetch one first", path = path.display())]
    Empty { path: PathBuf },
    #[error("{path}: {what}; fetch again, which writes it anew", path = path.display())]
    Current { path: PathBuf, what: String },
    #[error("{path} is missing, but `current` names it; fetch again", path = path.display())]
    Missing { path: PathBuf },
    #[error("{path} was found damaged; fetch again, which replaces it", path = path.display())]
    Damaged { path: PathBuf },
    #[error("{path}", path = path.display())]
    Manifest { path: PathBuf, source: ManifestError },
    #[error("{path}", path = path.display())]
    Shard { path: PathBuf, source: ContainerError },
    #[error("{path}: the manifest lists no {profile} shard of cell {cell_id}; fetch again", path = path.display())]
    Unlisted { path: PathBuf, cell_id: u32, profile: Profile },
    #[error("{path}: {what}; fetch again, which replaces it", path = path.display())]
    Wrong { path: PathBuf, what: String },
}

impl From<io::Error> for StoreError {
    fn from(e: io::Error) -> Self {
        // `InvalidData`: the file is too long.
        let is_damaged = is_bad_medium(&e) || e.kind() == io::ErrorKind::InvalidData;
        if is_damaged { Self::Unreadable(e) } else { Self::Io(e) }
    }
}

impl StoreError {
    /// Checks that bytes are those of a file named by their hash.
    pub(crate) fn check_hash(path: &Path, expected: Hash32, bytes: &[u8]) -> Result<(), Self> {
        match Hash32::of(bytes) {
            found if found == expected => Ok(()),
            found => {
                let what = format!("content has hash {found}, expected {expected}");
                Err(Self::Wrong { path: path.to_owned(), what })
            }
        }
    }

    /// Returns the error for what reading a file that must be there gave.
    pub(super) fn missing(path: &Path) -> impl Fn(io::Error) -> Self {
        move |e| match e.kind() {
            io::ErrorKind::NotFound => Self::Missing { path: path.to_owned() },
            _ => e.into(),
        }
    }

    pub(crate) fn is_damage(&self) -> bool {
        matches!(self, Self::Shard { .. } | Self::Wrong { .. } | Self::Unreadable(_))
    }
}
