//! Pulls public models into the user's cache, checks their hashes, and writes their [`ModelDir`](crate::ModelDir).
//!
//! A file's expected SHA-256 comes from the [`Table`], else the [`Lock`], else the hub. If none has it (small
//! files), the hash of the first download from the pinned commit is accepted, recorded in the lock, and reported.

mod cache;
mod download;
mod error;
mod lock;
mod pull;
mod table;

pub use cache::{Here, Hub};
pub use download::{HubOptions, MAX_FILE_BYTES};
pub use error::{HubError, Source};
pub use lock::{Accepted, Lock, LockedFile};
pub use pull::{PulledFile, Side, cache_folder, models_folder};
pub use table::{Entry, Known, Table};
