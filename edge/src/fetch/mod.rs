//! Fetch: downloads the shards around the robot and frees those left behind.
//!
//! An interruption at any moment leaves the old or the new generation, whole: files of `current` are untouched until
//! the new `current` is durable, and nothing unverified is used. In order:
//!
//! 0. lock; files renamed by a killed fetch are made durable before anything builds on them
//! 1. metadata: updated and recorded; manifest: hash, scene, encoder; scene and request are recorded
//! 2. history: objects of leaving shards are recorded (`history/`); space: shards of neither generation are removed
//! 3. each missing shard: staged, synced, hashed, checked, renamed into `shards/`; folder synced
//! 4. manifest: staged, synced, renamed into `manifests/`; folder synced
//! 5. `current`: written aside, synced, renamed; folder synced: this switches generations
//! 6. shards and manifests that only the old generation needed are removed

mod copies;
mod download;
mod error;
pub mod follow;
mod generation;
mod objects;
mod offer;
mod plan;
mod position;
mod records;
mod request;
mod run;
mod staging;
mod trust;

pub use download::check_address;
pub use error::FetchError;
pub use plan::{Held, Plan, Wanted};
pub use position::{NotAPosition, PlanError, Position, Spoken};
pub use records::{Accepted, LastFetch, Records, RecordsError, accepted, last_position, only_follower};
pub use request::{Environment, FetchReport, FetchRequest, Progress, Tally};
pub use run::fetch;
pub use slag_models::download::{DownloadFailure, NetworkLimits};
pub use trust::{AddedRoot, FirstRoot, add_root};
