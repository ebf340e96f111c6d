//! Errors of fetching.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;
use slag_models::download::{DownloadError, DownloadFailure};

use super::plan_error::PlanError;
use super::records::RecordsError;
use crate::store::StoreError;

/// Reasons for a failed fetch; the previous generation still answers.
#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// A value is neither in the request nor recorded by an earlier fetch.
    #[error("no {what} is given, and no earlier fetch recorded one; {advice}")]
    NotGiven {
        what: &'static str,
        /// How to give it.
        advice: &'static str,
    },
    /// The address is invalid.
    #[error("{from:?} is not the address of a store: {what}; give one like http://host:port")]
    Address { from: String, what: String },
    /// The file of certificate authorities is of no use.
    #[error("{}: {what}, expected certificates of authorities in PEM; check --ca", path.display())]
    Ca { path: PathBuf, what: String },
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
    Scene { expected: String, offered: String },
    /// The scene uses another embedding space.
    #[error(
        "the scene was encoded with encoder {found}, expected {expected}; use that model, or have the scene encoded again"
    )]
    Encoder {
        expected: Hash32,
        /// Encoder of the manifest.
        found: Hash32,
    },
    /// The store signed an object that is not a valid shard.
    #[error(
        "shard {hash} matches its hash but is not a valid shard of this scene; have the scene published again"
    )]
    Published { hash: Hash32, source: Box<StoreError> },
    /// The fetch cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// Shards are missing, and the network may not be used.
    #[error("{n_shards} shards ({bytes} bytes) are not on board; fetch with network")]
    Offline { n_shards: usize, bytes: u64 },
    /// The disk has too little space for the download.
    #[error(
        "{path}: {free_bytes} bytes are free, the fetch needs {needed_bytes}; free some space, or fetch a smaller radius", path = path.display()
    )]
    NoSpace {
        path: PathBuf,
        /// Bytes that are still to be written.
        needed_bytes: u64,
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

impl FetchError {
    /// Returns whether it may be gone once somebody has told the robot whom to trust.
    pub(super) fn is_want_of_trust(&self) -> bool {
        match self {
            Self::NoTrust { .. } | Self::OtherRoot { .. } => true,
            Self::Records(e) => matches!(e, RecordsError::Damaged { .. }),
            Self::Tuf(e) => matches!(e, TufError::Signatures { .. } | TufError::Expired { .. }),
            _ => false,
        }
    }

    pub(super) fn of_download(url: String, error: DownloadError) -> Self {
        match error {
            DownloadError::Failed { attempts, failure } => Self::Download { url, attempts, failure },
            DownloadError::Io(e) => Self::Io(e),
            DownloadError::Cancelled => Self::Cancelled,
            DownloadError::TooLong { max_bytes } => TufError::TooLong { what: url, max_bytes }.into(),
        }
    }
}
