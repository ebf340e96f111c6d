//! Why a fetch fails.

use std::io;
use std::time::Duration;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;

use super::plan_error::PlanError;
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
        failure: DownloadFailure,
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

/// Why one attempt failed.
#[derive(Debug, thiserror::Error)]
pub enum DownloadFailure {
    /// No connection, or it broke.
    #[error("{0}")]
    Transport(#[from] Box<ureq::Error>),
    /// The body broke off.
    #[error("the body ends at byte {found_bytes} of {expected_bytes}")]
    Cut {
        /// Length expected.
        expected_bytes: u64,
        /// Bytes there.
        found_bytes: u64,
    },
    /// The server says no.
    #[error("the server answers {status}")]
    Status {
        /// HTTP status.
        status: u16,
        /// When it asks to be asked again (429 and 503, `Retry-After` in seconds).
        retry_after: Option<Duration>,
    },
    /// The server sends to another address; shards and manifests are not followed elsewhere.
    #[error("the server sends to {location:?}; if that is the store, give that address")]
    Redirect {
        /// Where (cut to 200 characters).
        location: String,
    },
    /// The announced length is not the manifest's.
    #[error("the server announces {found:?} for {expected}")]
    Length {
        /// What the request asked for.
        expected: String,
        /// Header found.
        found: String,
    },
    /// The content is not what the hash names.
    #[error("the content has hash {found}, expected {expected}")]
    Hash {
        /// Hash expected.
        expected: Hash32,
        /// Hash of the content.
        found: Hash32,
    },
}

impl DownloadFailure {
    /// Whether another attempt may help.
    pub(super) fn is_passing(&self) -> bool {
        match self {
            Self::Redirect { .. } => false,
            Self::Status { status, .. } => *status >= 500 || matches!(status, 408 | 416 | 429),
            Self::Transport(e) => !matches!(**e, ureq::Error::BadUri(_) | ureq::Error::Http(_)),
            Self::Cut { .. } | Self::Length { .. } | Self::Hash { .. } => true,
        }
    }
}
