//! Errors of a store.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;

/// Why a store cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file operation failed; the text names the path.
    #[error("{0}; check permissions and free space")]
    Io(io::Error),
    /// Another process writes to the store.
    #[error("another slag-encoder is writing to {}; wait for it or stop it", store.display())]
    Locked {
        /// The store.
        store: PathBuf,
    },
    /// The record database is damaged or cannot be written.
    #[error(
        "{}: {cause}; if the database is damaged, remove this folder: published scenes stay, unfinished jobs start over",
        path.display()
    )]
    Records {
        /// The database's folder.
        path: PathBuf,
        /// The database's error.
        cause: sled::Error,
    },
    /// Nothing has been published yet.
    #[error("{} is missing: nothing has been published here yet; run `slag-encoder encode` first", path.display())]
    NotPublished {
        /// The manifest's file.
        path: PathBuf,
    },
    /// A key file does not hold 64 hex digits.
    #[error("{}: expected 64 hex digits; restore the file from a backup, or remove it: a new key is made, which robots must be told", path.display())]
    Key {
        /// The key file.
        path: PathBuf,
    },
    /// The stored manifest cannot be verified.
    #[error("{}: {cause}", path.display())]
    Manifest {
        /// The manifest's file.
        path: PathBuf,
        /// The cause.
        cause: ManifestError,
    },
    /// Stored metadata is damaged.
    #[error("{}: {cause}; restore the store's folder metadata/ from a backup", path.display())]
    Metadata {
        /// The metadata file.
        path: PathBuf,
        /// The cause.
        cause: TufError,
    },
    /// A role's key is not the one that the root names.
    #[error("{}: the newest root does not name the key in keys/{role}.key; restore that file, or run `slag-encoder keys rotate {role}`", path.display())]
    RoleKey {
        /// The role.
        role: String,
        /// The folder of the roots.
        path: PathBuf,
    },
    /// The list of a generation's extra objects is damaged.
    #[error("{}: {what}; encode again", path.display())]
    Extras {
        /// The record's file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A manifest lists an object that the store does not hold.
    #[error(
        "object {hash}: expected {expected_bytes} bytes at {}, found {}; put the object before publishing",
        path.display(),
        found_bytes.map_or("nothing".into(), |n| format!("{n} bytes"))
    )]
    MissingObject {
        /// The object.
        hash: Hash32,
        /// Its file.
        path: PathBuf,
        /// Length listed.
        expected_bytes: u64,
        /// Length found, if the file exists.
        found_bytes: Option<u64>,
    },
    /// An object's content does not match its name.
    #[error("{}: content has hash {found}, not that of its name: the file is damaged; remove it and encode again", path.display())]
    ObjectHash {
        /// The object's file.
        path: PathBuf,
        /// Hash of the content.
        found: Hash32,
    },
    /// The store has a root already.
    #[error("{} has a root already; to change its keys, run `slag-encoder keys rotate` or `revoke`", store.display())]
    HasRoot {
        /// The store.
        store: PathBuf,
    },
    /// The store has no root yet.
    #[error("{} has no root yet; run `slag-encoder keys init`, or encode", store.display())]
    NoRoot {
        /// The store.
        store: PathBuf,
    },
    /// The root names no such key.
    #[error("no role has the key {id}; `slag-encoder keys status` lists the keys")]
    NoSuchKey {
        /// The id given.
        id: String,
    },
    /// A root is not signed as it must be.
    #[error("{}: {cause}; have `slag-encoder keys sign` sign the draft where root's keys lie", path.display())]
    RootDraft {
        /// The draft.
        path: PathBuf,
        /// The cause.
        cause: TufError,
    },
    /// A generation is not above the current one: robots would go back.
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
