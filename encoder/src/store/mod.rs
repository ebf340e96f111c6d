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

mod catalogue;
pub(crate) mod ceremony;
#[cfg(test)]
mod ceremony_tests;
mod error;
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
pub(crate) use error::{StoreError, io_help, records_help};
pub(crate) use export::{Exported, export};
pub(crate) use files::ModelsRecord;
pub(crate) use files::remove_files;
pub use reader::{Extras, StoreReader};
pub(crate) use reader::{Published, Stamp, StoredShard, scene_name};
pub(crate) use verify::{Fault, Verified};
pub use writer::Store;
pub(crate) use writer::check_folder;
