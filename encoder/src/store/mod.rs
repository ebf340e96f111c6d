//! The cloud store: a scene's objects, manifest and records.
//!
//! | path | content |
//! |---|---|
//! | `objects/ab/HASH` | immutable files named by the BLAKE3 of their content |
//! | `manifest` | the current manifest |
//! | `manifest.previous` | the one before it, which fetches under way may still need |
//! | `extras/MANIFEST_HASH` | JSON name -> object hash: objects that belong to that manifest but not to robots |
//! | `models.json` | name or folder of the models of the last encode, for queries on this machine |
//! | `keys/` | signing keys (mode 0600), hex: see [`ceremony`] |
//! | `metadata/` | metadata of The Update Framework: see [`metadata`] |
//! | `db/` | sled: see [`catalogue`]; a damaged one is renamed to `db.damaged` |
//! | `job/` | working files of an unfinished encode |
//! | `tmp/` | files being written |
//!
//! **Crash safety.** [`Store::publish`] leaves a whole store after each step: first durable objects (synced and renamed
//! one by one, and checked here), then `extras/NEW`, then `manifest.previous` becomes the current one, then `manifest`
//! is replaced. That rename is the commit for readers on this machine; it switches extras as well, which are named by
//! their manifest's hash. Clients of the metadata follow `metadata/timestamp.json`, which comes after it. The catalogue
//! in sled repeats the manifests, and knows the generations before them. The next [`Store::create_or_open`] completes
//! metadata and records after a crash.

use std::io;
use std::path::{Path, PathBuf};

use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;

mod catalogue;
pub(crate) mod ceremony;
#[cfg(test)]
mod ceremony_tests;
mod export;
mod files;
pub(crate) mod metadata;
#[cfg(test)]
mod metadata_tests;
mod reader;
mod roles;
#[cfg(test)]
pub(crate) mod tests;
mod verify;
#[cfg(test)]
mod walk_tests;
mod writer;

pub(crate) use catalogue::{CatalogueCopy, GenerationRecord};
pub(crate) use export::{Exported, export};
pub(crate) use files::{ModelsRecord, remove_files};
pub use reader::{Extras, StoreReader};
pub(crate) use reader::{Published, Stamp, StoredShard, scene_name};
pub(crate) use verify::{Fault, Verified};
pub use writer::Store;
pub(crate) use writer::check_folder;

#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    #[error("{0}; {help}", help = io_help(.0))]
    Io(io::Error),
    #[error("another slag-encoder is writing to {}; wait for it or stop it", store.display())]
    Locked { store: PathBuf },
    #[error(
        "{}: {cause}; {}", path.display(),
        records_help(cause, "if the database is damaged, remove this folder: published scenes stay, unfinished jobs start over")
    )]
    Records { path: PathBuf, cause: sled::Error },
    /// A message that says what to do.
    #[error("{0}")]
    Failed(String),
    /// Two generations cannot be compared: why, and what to do.
    #[error("{0}")]
    NotComparable(String),
    #[error("{} is missing: nothing has been published here yet; run `slag-encoder encode` first", path.display())]
    NotPublished { path: PathBuf },
    #[error("{} is missing, though a scene was published here; run `slag-encoder encode` again, which writes it anew", path.display())]
    ManifestLost { path: PathBuf },
    #[error("{}: {what}; {help}", path.display())]
    Key { path: PathBuf, what: &'static str, help: String },
    #[error("{}: {}{}", path.display(), manifest_fault(cause), manifest_help(cause))]
    Manifest { path: PathBuf, cause: ManifestError },
    #[error("{}: {cause}; the store's metadata vouches for it, so it is not damaged", path.display())]
    SignedManifest { path: PathBuf, cause: ManifestError },
    #[error("{}: {}; {}", path.display(), metadata_fault(cause), metadata_help(path))]
    Metadata { path: PathBuf, cause: TufError },
    #[error(
        "{} is missing, but the store was signed by it; {ROOT_HELP}; without one, encode into a new store, and tell robots of its root (`slag-edge trust add`)",
        path.display()
    )]
    RootLost { path: PathBuf },
    #[error("{}: robots refuse it: {what}", path.display())]
    Refused { path: PathBuf, what: String },
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

/// Help for a damaged or missing root: nothing else may replace it.
const ROOT_HELP: &str =
    "copy it from a backup of the store, or from v1/metadata/ of what `slag-encoder store export` wrote";

pub(crate) fn io_help(error: &io::Error) -> &'static str {
    by_the_system(error).unwrap_or("check permissions and free space")
}

/// Help for an error of the database: `otherwise`, unless the disk is at fault.
pub(crate) fn records_help(error: &sled::Error, otherwise: &'static str) -> &'static str {
    match error {
        sled::Error::Io(error) => by_the_system(error).unwrap_or(otherwise),
        _ => otherwise,
    }
}

fn by_the_system(error: &io::Error) -> Option<&'static str> {
    use io::ErrorKind as Kind;

    // sled wraps some errors, so that only the text tells.
    let is_full = || error.to_string().contains("No space left");
    match error.kind() {
        Kind::StorageFull | Kind::QuotaExceeded => Some(FULL),
        Kind::PermissionDenied => Some("give this user the right to read and write there"),
        Kind::IsADirectory | Kind::NotADirectory | Kind::DirectoryNotEmpty => Some(
            "a file lies where the store has a folder, or a folder where it has a file; name another place, or move it away",
        ),
        Kind::ReadOnlyFilesystem => Some("its disk takes no writes: mount it for writing, or use a copy"),
        _ => is_full().then_some(FULL),
    }
}

const FULL: &str = "free space on that disk, then run the same command again: what is done is kept";

pub(super) fn manifest_fault(cause: &ManifestError) -> String {
    match cause {
        ManifestError::Version { .. } => cause.to_string(),
        ManifestError::TooLong { len_bytes } => format!("it is damaged: it has {len_bytes} bytes"),
        ManifestError::Damaged { what } => format!("it is damaged: {what}"),
        ManifestError::Content { what } => {
            format!("it is damaged, or another version of slag-encoder wrote it: {what}")
        }
    }
}

fn manifest_help(cause: &ManifestError) -> &'static str {
    match cause {
        // The fault includes the help.
        ManifestError::Version { .. } => "",
        _ => "; run `slag-encoder encode` again, which writes it anew",
    }
}

/// Fault of metadata, for the store's owner: other advice than robots get.
pub(super) fn metadata_fault(cause: &TufError) -> String {
    match cause {
        TufError::Format { what, .. } => format!("it is damaged: {what}"),
        TufError::Signatures { found, threshold, .. } => {
            format!("{found} of its role's keys signed it, expected {threshold}")
        }
        TufError::Rollback { seen, offered, .. } => format!("version {offered} follows {seen}"),
        TufError::Version { expected, found, .. } => format!("version {found}, expected {expected}"),
        TufError::Expired { expired, .. } => format!("it expired at {expired}"),
        TufError::Content { fault, .. } | TufError::Source { fault, .. } => fault.clone(),
        TufError::TooLong { max_bytes, .. } => format!("it has more than {max_bytes} bytes"),
        TufError::Missing { .. } => "it is missing".into(),
        TufError::Order { .. } | TufError::TooMany { .. } => cause.to_string(),
    }
}

pub(super) fn metadata_help(path: &Path) -> &'static str {
    let is_root = path.to_str().is_some_and(|path| path.ends_with(".root.json"));
    if is_root { ROOT_HELP } else { "run `slag-encoder store refresh`, which signs it anew" }
}
