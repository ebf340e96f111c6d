//! What can go wrong with a store.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;

/// Why a store cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The file system refused; the text names the path.
    #[error("{0}; check permissions and free space")]
    Io(io::Error),
    /// A second writer.
    #[error("another slag-encoder is writing to {}; wait for it or stop it", store.display())]
    Locked {
        /// The store.
        store: PathBuf,
    },
    /// The record database is damaged or cannot be written.
    #[error(
        "{}: {cause}; if it is damaged, remove this folder: published scenes stay, unfinished jobs start over",
        path.display()
    )]
    Records {
        /// The database's folder.
        path: PathBuf,
        /// What it says.
        cause: sled::Error,
    },
    /// Nothing was published yet.
    #[error("{} is missing: nothing was published here yet; run `slag-encoder encode` first", path.display())]
    NotPublished {
        /// Where the manifest belongs.
        path: PathBuf,
    },
    /// A key file that is not 64 hex digits.
    #[error("{}: expected 64 hex digits; restore it from a backup, or remove it: robots must then accept a new key", path.display())]
    Key {
        /// The key file.
        path: PathBuf,
    },
    /// The stored manifest is refused.
    #[error("{}: {cause}", path.display())]
    Manifest {
        /// The manifest's file.
        path: PathBuf,
        /// Why.
        cause: ManifestError,
    },
    /// The record of what was published beside the shards is damaged.
    #[error("{}: {what}; encode again", path.display())]
    Extras {
        /// The record's file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A manifest lists what the store does not hold.
    #[error(
        "object {hash}: expected {expected_bytes} bytes at {}, found {}; put the object before publishing",
        path.display(),
        found_bytes.map_or("nothing".into(), |n| format!("{n} bytes"))
    )]
    MissingObject {
        /// The object.
        hash: Hash32,
        /// Where it belongs.
        path: PathBuf,
        /// Length listed.
        expected_bytes: u64,
        /// Length there, if any.
        found_bytes: Option<u64>,
    },
    /// An object whose content is not what its name says.
    #[error("{}: content has hash {found}; the file is damaged, remove it and encode again", path.display())]
    ObjectHash {
        /// The object's file.
        path: PathBuf,
        /// Hash of the content.
        found: Hash32,
    },
    /// A change of keys out of order.
    #[error("{}: {what}; run `slag-encoder keys rotate` first, and finish once every robot has fetched", store.display())]
    Rotation {
        /// The store.
        store: PathBuf,
        /// What is missing.
        what: &'static str,
    },
    /// The first key is there already.
    #[error("{} has a key already; to change it, run `slag-encoder keys rotate`", store.display())]
    HasKey {
        /// The store.
        store: PathBuf,
    },
    /// A generation that would take robots back.
    #[error("generation {found} cannot follow {current}; take the number from `next_generation`")]
    Generation {
        /// Generation offered.
        found: u64,
        /// Highest generation published.
        current: u64,
    },
}

impl From<io::Error> for StoreError {
    fn from(cause: io::Error) -> Self {
        Self::Io(cause)
    }
}
