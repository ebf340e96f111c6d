//! Why a fetch fails.

use std::io;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;

use super::download::Failure;
use super::plan::PlanError;
use super::records::RecordsError;
use crate::store::StoreError;

/// Why a fetch failed; the generation before it still answers.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// Neither the request nor an earlier fetch says it.
    #[error("the {what} is not given, and no earlier fetch recorded one: give it")]
    NotGiven {
        /// What is missing.
        what: &'static str,
    },
    /// The address is none.
    #[error("{from:?} is no address of a store: {what}; expected something like http://host:port")]
    Address {
        /// The address.
        from: String,
        /// What is wrong.
        what: String,
    },
    /// The records cannot be used.
    #[error(transparent)]
    Records(#[from] RecordsError),
    /// The cache cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The server or the way to it.
    #[error(
        "{url}: {failure} ({attempts} attempts); check the address and the connection, then fetch again: what came in is kept"
    )]
    Download {
        /// What was asked for.
        url: String,
        /// Attempts in a row.
        attempts: u32,
        /// Why the last one failed.
        failure: Failure,
    },
    /// The manifest is refused.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The manifest is older than one that was accepted.
    #[error(
        "scene {scene:?} is offered as generation {offered}, generation {seen} was accepted before: an old manifest is being replayed, or the store was restored from a backup; publish a newer one"
    )]
    Rollback {
        /// The scene.
        scene: String,
        /// Highest generation accepted.
        seen: u64,
        /// Generation offered.
        offered: u64,
    },
    /// The scene speaks another embedding space.
    #[error(
        "the scene was encoded by {found}, expected is {expected}; use that model, or have the scene encoded again"
    )]
    Encoder {
        /// Encoder expected.
        expected: Hash32,
        /// Encoder of the manifest.
        found: Hash32,
    },
    /// The store signed a shard that no one can use.
    #[error("shard {hash} has its hash but is no shard of this scene; have the scene published again")]
    Published {
        /// The shard.
        hash: Hash32,
        /// What is wrong.
        source: Box<StoreError>,
    },
    /// No plan.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Without network it cannot be done.
    #[error("{n_shards} shards ({bytes} bytes) are not on board: fetch with network")]
    Offline {
        /// Shards missing.
        n_shards: usize,
        /// Their bytes.
        bytes: u64,
    },
    /// No space left.
    #[error(
        "the disk is full: {source}; free {needed_bytes} bytes, or take a smaller radius (what came in was removed)"
    )]
    DiskFull {
        /// Bytes of the shards to download.
        needed_bytes: u64,
        /// The file system's error, with the path.
        source: io::Error,
    },
    /// The file system's error, with the path.
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
    /// The cancel flag was set.
    #[error("cancelled; fetch again to go on where it ended")]
    Cancelled,
}
