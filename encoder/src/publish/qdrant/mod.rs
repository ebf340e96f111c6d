//! Pushes a scene's embeddings into Qdrant: one point a Gaussian.
//!
//! A collection holds one scene, or one cell of it ([`Layout`]). A point's id is the Gaussian's index in the input
//! splat file. Its payload has `x`, `y`, `z` (world frame), `cell_id`, `scene`, `generation` and, if the scene is
//! geo-referenced, `location` (`lat`, `lon`).
//!
//! Each batch is acknowledged as applied and recorded in the store before the next is sent, so that an interrupted push
//! continues there. Upserts by id are idempotent: a batch without acknowledgement may be sent again.

mod database;
mod push;
mod settings;
#[cfg(test)]
mod tests;

use std::num::NonZeroUsize;
use std::time::Duration;

use clap::{Args, ValueEnum};
use serde::Serialize;
use slag_common::shard::Profile;

use crate::store::StoreError;

pub(crate) use push::push;
pub(crate) use settings::IndexSettings;

/// Which collections a scene is pushed to.
///
/// Shard keys, which divide one collection, need a distributed Qdrant; a collection a cell needs nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Layout {
    /// One collection, NAME.
    One,
    /// A collection for each cell, NAME-cell-ID: each can be snapshotted, dropped and restored alone.
    Cells,
}

/// Where a scene is pushed to, and how.
#[derive(Clone, Debug, Args)]
pub struct PushOptions {
    /// Qdrant's gRPC address.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:6334")]
    pub url: String,
    /// Collection; created if it does not exist. With `--layout cells`: NAME-cell-ID for each cell.
    #[arg(long, value_name = "NAME")]
    pub(crate) collection: String,
    /// API key.
    #[arg(long, value_name = "KEY", env = "QDRANT_API_KEY", hide_env_values = true)]
    pub(crate) api_key: Option<String>,
    /// Points per request.
    #[arg(long = "batch", value_name = "N", default_value = "256")]
    pub(crate) n_points_per_batch: NonZeroUsize,
    /// One collection for the scene, or one for each cell.
    #[arg(long, value_enum, default_value = "one")]
    pub layout: Layout,
    /// Makes a snapshot of each collection at the end, on the server's disk.
    #[arg(long)]
    pub(crate) snapshots: bool,
    /// Settings of the collections.
    #[command(flatten)]
    pub(crate) index: IndexSettings,
    /// Attempts after the first, for errors that may pass: over about a minute.
    #[arg(skip = 8_u32)]
    pub(crate) n_retries: u32,
    /// Pause before the second attempt; it doubles with each.
    #[arg(skip = Duration::from_millis(250))]
    pub(crate) retry_delay: Duration,
    /// How long a database that was never reached is waited for.
    #[arg(skip = Duration::from_secs(10))]
    pub(crate) connect_patience: Duration,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PushProgress {
    pub(crate) n_points: u64,
    /// Points of this generation at the end.
    pub(crate) n_points_expected: u64,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Snapshot {
    pub(crate) collection: String,
    pub(crate) name: String,
    pub(crate) size_bytes: u64,
    /// SHA-256 of the file, hexadecimal; servers before 1.8 state none.
    pub(crate) sha256: Option<String>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct PushReport {
    /// Points of this generation, all in the database.
    pub(crate) n_points: u64,
    /// Points sent by this run; earlier runs sent the others.
    pub(crate) n_sent: u64,
    /// Gaussians without an embedding, left out.
    pub(crate) n_without_evidence: u64,
    pub(crate) n_retries: u64,
    pub(crate) n_collections: usize,
    pub(crate) n_created_collections: usize,
    /// Collections of cells that this generation no longer has, deleted.
    pub(crate) deleted_collections: Vec<String>,
    pub(crate) snapshots: Vec<Snapshot>,
}

#[derive(Debug, thiserror::Error)]
pub(crate) enum PushError {
    #[error(
        "collection {collection:?} has {found}, this scene needs {expected}; choose another collection, or delete this one"
    )]
    Collection { collection: String, found: String, expected: String },
    #[error(
        "collection {collection:?} holds {n_points} points of another store, and ids would collide; choose another \
         collection, or delete this one"
    )]
    OtherStore { collection: String, n_points: u64 },
    #[error(
        "{url}: {action}: {cause}; does Qdrant run there, and is this its gRPC port (6334 by default; 6333 is REST's)? Check the key and the database's log, then run the push again: it continues"
    )]
    Database { url: String, action: &'static str, cause: String },
    #[error(
        "{url:?} is no address of Qdrant; write http://HOST:6334, or https:// where it has a certificate"
    )]
    Url { url: String },
    #[error("cell {cell_id} has no shard of profile {}; encode the scene with that profile", Profile::Exact)]
    NoShard { cell_id: u32 },
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("the progress of the push cannot be recorded: {0}; check the store's free space and permissions")]
    Records(#[from] sled::Error),
    #[error(
        "collection {collection:?} has {found} points, {expected} were pushed; another program may have changed it; run the push again: it starts over"
    )]
    Count { collection: String, expected: u64, found: u64 },
    #[error("the database describes no snapshot of collection {collection:?}; see its log")]
    NoSnapshot { collection: String },
    #[error("the push was stopped; run the push again: it continues")]
    Cancelled,
}
