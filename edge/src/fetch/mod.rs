//! Fetch: brings the shards around the robot on board and frees those it left behind.
//!
//! An interruption at any moment leaves the old or the new generation, whole: nothing named by `current` is
//! touched before the new `current` is durable, and nothing unverified is used. In order:
//!
//! 0. lock; files renamed by a killed fetch are made durable before anything builds on them
//! 1. metadata: brought up to date and recorded; manifest: hash, scene, encoder; scene and request are recorded
//! 2. history: the objects of shards that will go are recorded (`history/`); space: shards that neither the old
//!    nor the new generation needs are removed
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
pub use records::{Accepted, LastFetch, Records, RecordsError, accepted, last_position};
pub use request::{Environment, FetchReport, FetchRequest, Progress, Tally};
pub use run::fetch;
pub use slag_models::download::{DownloadFailure, NetworkLimits};
pub use trust::{AddedRoot, FirstRoot, add_root};
