//! Errors of a store.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("{0}; check permissions and free space")]
    Io(io::Error),
    #[error("another slag-encoder is writing to {}; wait for it or stop it", store.display())]
    Locked { store: PathBuf },
    #[error(
        "{}: {cause}; if the database is damaged, remove this folder: published scenes stay, unfinished jobs start over",
        path.display()
    )]
    Records { path: PathBuf, cause: sled::Error },
    #[error("this machine's clock says a time before 1970; set it")]
    Clock,
    #[error("{} is missing: nothing has been published here yet; run `slag-encoder encode` first", path.display())]
    NotPublished { path: PathBuf },
    #[error("{}: expected 64 hex digits; restore the file from a backup, or remove it: a new key is made, which robots must be told", path.display())]
    Key { path: PathBuf },
    #[error("{}: {cause}", path.display())]
    Manifest { path: PathBuf, cause: ManifestError },
    #[error("{}: {cause}; restore the store's folder metadata/ from a backup", path.display())]
    Metadata { path: PathBuf, cause: TufError },
    #[error("{}: the newest root does not name the key in keys/{role}.key; restore that file, or run `slag-encoder keys rotate {role}`", path.display())]
    RoleKey { role: String, path: PathBuf },
    #[error("{}: {what}; encode again", path.display())]
    Extras { path: PathBuf, what: String },
    #[error(
        "object {hash}: expected {expected_bytes} bytes at {}, found {}; put the object before publishing",
        path.display(),
        found_bytes.map_or("nothing".into(), |n| format!("{n} bytes"))
    )]
    MissingObject { hash: Hash32, path: PathBuf, expected_bytes: u64, found_bytes: Option<u64> },
    #[error("{}: content has hash {found}, not that of its name: the file is damaged; remove it and encode again", path.display())]
    ObjectHash { path: PathBuf, found: Hash32 },
    #[error("{}: {cause}; encode again: what is damaged is written anew", path.display())]
    Shard { path: PathBuf, cause: ContainerError },
    #[error("{} has a root already; to change its keys, run `slag-encoder keys rotate` or `revoke`", store.display())]
    HasRoot { store: PathBuf },
    #[error("{} has no root yet; run `slag-encoder keys init`, or encode", store.display())]
    NoRoot { store: PathBuf },
    #[error("no role has the key {id}; `slag-encoder keys status` lists the keys")]
    NoSuchKey { id: String },
    #[error("{}: {cause}; have `slag-encoder keys sign` sign the draft where root's keys lie", path.display())]
    RootDraft { path: PathBuf, cause: TufError },
    #[error("generation {found} cannot follow {current}; take the number from `next_generation`")]
    Generation { found: u64, current: u64 },
}

impl From<io::Error> for StoreError {
    fn from(cause: io::Error) -> Self {
        Self::Io(cause)
    }
}
