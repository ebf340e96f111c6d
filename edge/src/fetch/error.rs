//! Errors of fetching and downloading.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;

use super::plan_error::PlanError;
use super::records::RecordsError;
use crate::store::StoreError;

/// Reasons for a failed fetch; the previous generation still answers.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// A value is neither in the request nor recorded by an earlier fetch.
    #[error("no {what} is given, and no earlier fetch recorded one; {advice}")]
    NotGiven {
        /// The missing value.
        what: &'static str,
        /// How to give it.
        advice: &'static str,
    },
    /// The address is invalid.
    #[error("{from:?} is not the address of a store: {what}; give one like http://host:port")]
    Address {
        /// The address.
        from: String,
        /// What is wrong.
        what: String,
    },
    /// The file of certificate authorities is of no use.
    #[error("{}: {what}, expected certificates of authorities in PEM; check --ca", path.display())]
    Ca {
        /// The file.
        path: PathBuf,
        /// The fault.
        what: String,
    },
    /// The records cannot be used.
    #[error(transparent)]
    Records(#[from] RecordsError),
    /// The cache cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The server or the network failed.
    #[error(
        "{url}: {failure} ({attempts} attempts); check the address and the connection, then fetch again: bytes received so far are kept"
    )]
    Download {
        /// The URL requested.
        url: String,
        /// Attempts in a row.
        attempts: u32,
        /// Why the last one failed.
        failure: DownloadFailure,
    },
    /// The manifest is invalid.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The store's metadata is refused.
    #[error(transparent)]
    Tuf(#[from] TufError),
    /// No root is trusted yet.
    #[error(
        "this robot trusts no store yet; run `slag-edge trust add {from} --sha256 HEX` with the SHA-256 that `slag-encoder keys status` prints there, or fetch once with --trust-first to trust whoever answers there"
    )]
    NoTrust {
        /// Address of the store.
        from: String,
    },
    /// Another root is trusted.
    #[error(
        "this robot began with another root, {held}, than the one offered, {offered}; to trust the latter in its place, add it with --replace"
    )]
    OtherRoot {
        /// SHA-256 of the root that was trusted first.
        held: String,
        /// SHA-256 of the one offered.
        offered: String,
    },
    /// The store has no root of a given hash.
    #[error("{from} has no root with SHA-256 {sha256}; check the hash and the address")]
    NoSuchRoot {
        /// Address of the store.
        from: String,
        /// The hash.
        sha256: String,
    },
    /// The store offers another scene.
    #[error(
        "the store offers scene {offered:?}, this robot expects {expected:?}; check the address, or change the robot's scene once with `slag-edge fetch --scene NAME`"
    )]
    Scene {
        /// Scene expected.
        expected: String,
        /// Scene offered.
        offered: String,
    },
    /// The scene uses another embedding space.
    #[error(
        "the scene was encoded with encoder {found}, expected {expected}; use that model, or have the scene encoded again"
    )]
    Encoder {
        /// Encoder expected.
        expected: Hash32,
        /// Encoder of the manifest.
        found: Hash32,
    },
    /// The store signed an object that is not a valid shard.
    #[error(
        "shard {hash} matches its hash but is not a valid shard of this scene; have the scene published again"
    )]
    Published {
        /// The shard.
        hash: Hash32,
        /// What is wrong.
        source: Box<StoreError>,
    },
    /// The fetch cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Shards are missing, and the network may not be used.
    #[error("{n_shards} shards ({bytes} bytes) are not on board; fetch with network")]
    Offline {
        /// Shards missing.
        n_shards: usize,
        /// Their bytes.
        bytes: u64,
    },
    /// The disk has too little space for the download.
    #[error(
        "{path}: {free_bytes} bytes are free, the fetch needs {needed_bytes}; free some space, or fetch a smaller radius", path = path.display()
    )]
    NoSpace {
        /// The cache.
        path: PathBuf,
        /// Bytes that are still to be written.
        needed_bytes: u64,
        /// Bytes free.
        free_bytes: u64,
    },
    /// The disk became full.
    #[error(
        "the disk is full: {source}; free up to {needed_bytes} bytes, or fetch a smaller radius (bytes received so far are kept)"
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
    #[error("cancelled; fetch again to resume")]
    Cancelled,
}

/// Reasons for a failed attempt.
#[derive(Debug, thiserror::Error)]
pub enum DownloadFailure {
    /// The connection failed.
    #[error("{0}")]
    Transport(#[from] Box<ureq::Error>),
    /// The server's certificate is refused, or TLS failed otherwise.
    #[error("TLS failed: {0}; give the authority that vouches for the server with --ca FILE")]
    Tls(String),
    /// The body broke off.
    #[error("the body ended at byte {found_bytes} of {expected_bytes}")]
    Cut {
        /// Length expected.
        expected_bytes: u64,
        /// Bytes received.
        found_bytes: u64,
    },
    /// The server refuses.
    #[error("the server answered with status {status}")]
    Status {
        /// HTTP status.
        status: u16,
        /// When to ask again (429 and 503, `Retry-After` in seconds).
        retry_after: Option<Duration>,
    },
    /// The server redirects; shards and manifests are not fetched from elsewhere.
    #[error("the server redirects to {location:?}; if that is the store, fetch from that address")]
    Redirect {
        /// The target (cut to 200 characters).
        location: String,
    },
    /// The announced length differs from the manifest's.
    #[error("the server announces {found:?}, expected {expected}")]
    Length {
        /// The length requested.
        expected: String,
        /// The header found.
        found: String,
    },
    /// The content does not have the expected hash.
    #[error("the content has hash {found}, expected {expected}")]
    Hash {
        /// Hash expected.
        expected: Hash32,
        /// Hash of the content.
        found: Hash32,
    },
}

impl DownloadFailure {
    /// Returns whether another attempt may help.
    pub(super) fn is_passing(&self) -> bool {
        match self {
            // A certificate does not become another one by asking again.
            Self::Redirect { .. } | Self::Tls(_) => false,
            Self::Status { status, .. } => *status >= 500 || matches!(status, 408 | 416 | 429),
            Self::Transport(e) => !matches!(**e, ureq::Error::BadUri(_) | ureq::Error::Http(_)),
            Self::Cut { .. } | Self::Length { .. } | Self::Hash { .. } => true,
        }
    }
}
