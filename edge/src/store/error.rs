//! Errors of the cache.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::ManifestError;
use slag_common::shard::Profile;

/// Reasons for which a cache cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The file system's error, with the path.
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
    /// Nothing was fetched yet.
    #[error("{path} holds no scene yet; fetch one first", path = path.display())]
    Empty {
        /// The cache.
        path: PathBuf,
    },
    /// The generation pointer is damaged.
    #[error("{path}: {what}; fetch again, which writes it anew", path = path.display())]
    Current {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A file named by `current` is missing.
    #[error("{path} is missing, but `current` names it; fetch again", path = path.display())]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// A shard was found damaged before, and not replaced since.
    #[error("{path} was found damaged; fetch again, which replaces it", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// A file's content does not match its name.
    #[error("{path}: content has hash {found}, expected {expected}; fetch again, which replaces it", path = path.display())]
    Hash {
        /// The file.
        path: PathBuf,
        /// Hash expected.
        expected: Hash32,
        /// Hash of the content.
        found: Hash32,
    },
    /// The manifest is invalid.
    #[error("{path}", path = path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: ManifestError,
    },
    /// The shard is damaged.
    #[error("{path}", path = path.display())]
    Shard {
        /// The file.
        path: PathBuf,
        /// The reason and place.
        source: ContainerError,
    },
    /// `current` names a cell or profile that the manifest does not list.
    #[error("{path}: the manifest lists no {profile} shard of cell {cell_id}; fetch again", path = path.display())]
    Unlisted {
        /// The file.
        path: PathBuf,
        /// The cell.
        cell_id: u32,
        /// The profile.
        profile: Profile,
    },
    /// The shard is intact but differs from the manifest's description.
    #[error("{path}: {field} is {found}, the manifest says {expected}; fetch again, which replaces it", path = path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// The field that differs.
        field: &'static str,
        /// Value in the manifest.
        expected: String,
        /// Value found.
        found: String,
    },
}
