//! Public models in the user's cache: pulled once, checked, described for [`ModelDir`](crate::ModelDir).
//!
//! A file counts when its SHA-256 is the one of the [`Table`], else the one that the [`Lock`] has accepted before, else
//! the one that the hub advertises. Where nobody states one (small files), the first download over the connection to
//! the pinned commit is accepted and locked, and reported as such.

mod cache;
mod download;
mod error;
mod lock;
mod options;
mod pull;
mod source;
mod table;

pub use cache::{Here, Hub};
pub use download::{Failure, MAX_FILE_BYTES};
pub use error::{HubError, Wanted};
pub use lock::{Accepted, Lock, LockedFile};
pub use options::{HubOptions, cache_folder, models_folder};
pub use pull::{PulledFile, Side};
pub use source::Source;
pub use table::{Entry, Known, Table};
