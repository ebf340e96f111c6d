//! The cache on the robot: where shards lie, and how a consistent set of them is opened.
//!
//! | path | what | changed by |
//! |---|---|---|
//! | `shards/HASH` | verified shards, immutable | fetch: renamed in, removed |
//! | `manifests/HASH` | verified signed manifests, immutable | fetch: renamed in, removed |
//! | `current` | [`Current`]: the generation that answers come from | fetch: replaced whole |
//! | `staging/` | downloads under way | fetch |
//! | `db/` | the fetcher's records | fetch |
//!
//! Readers need no lock: they read `current` and what it names, and start over if a fetch replaced it
//! meanwhile.

mod cache;
mod error;
pub mod files;
pub mod mmap;
pub mod objects;
mod shard;
mod snapshot;

pub use cache::{Current, CurrentCell, EdgeCache};
pub use error::StoreError;
pub use shard::{OpenShard, check_shard};
pub use snapshot::Snapshot;
pub(crate) use snapshot::beside_queries;
