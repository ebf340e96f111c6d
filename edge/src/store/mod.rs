//! The cache on the robot: its files, and how readers open a consistent set.
//!
//! | path | content | changed by |
//! |---|---|---|
//! | `shards/HASH` | verified shards and files of text models, immutable | fetch: renamed in, removed |
//! | `manifests/HASH` | verified manifests, immutable | fetch: renamed in, removed |
//! | `current` | [`Current`]: the generation in use | fetch: replaced whole |
//! | `staging/` | partial downloads | fetch |
//! | `damaged/HASH` | marks of shards that were found damaged | readers: added; fetch: removed |
//! | `history/GENERATION` | the objects of earlier generations; may be lost | fetch: replaced whole, removed |
//! | `words/ENCODER` | vectors of the words that things are named by; may be lost | `serve`, `list`: replaced whole |
//! | `trust/` | accepted metadata and scene, in two copies | fetch |
//! | `usage.json` | when each shard was needed last; may be lost | fetch: replaced whole |
//! | `lock` | locked by the one fetch | |
//! | `follower` | locked by the one program that follows a robot | |
//!
//! Readers need no lock: they read `current` and the files it names, and start over if a fetch replaces it meanwhile.

mod cache;
mod error;
pub mod files;
pub mod history;
pub mod mmap;
pub mod objects;
mod scrubber;
mod shard;
mod snapshot;
pub mod words;

pub use cache::{BadCell, CellFault, Current, CurrentCell, EdgeCache, OldShard, can_stand_in, cell_of};
pub use error::StoreError;
pub use scrubber::{Scrubbed, Scrubber};
pub use shard::{Listed, OpenShard};
pub use snapshot::Snapshot;
pub(crate) use snapshot::beside_queries;
