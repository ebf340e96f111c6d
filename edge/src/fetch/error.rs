//! Errors of fetching.

use std::io;
use std::path::PathBuf;

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_common::tuf::TufError;
use slag_models::download::{DownloadError, DownloadFailure};

use super::position::PlanError;
use super::records::RecordsError;
use crate::store::StoreError;

#[derive(Debug, thiserror::Error)]
pub enum FetchError {
    /// What the request lacks or names wrongly, and what to do.
    #[error("{0}")]
    Request(String),
    #[error(transparent)]
    Records(#[from] RecordsError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{url}: {failure} ({attempts} attempts){}", what_next(failure, *kept_bytes))]
    Download {
        url: String,
        attempts: u32,
        failure: DownloadFailure,
        /// Of the file, for the next fetch to resume.
        kept_bytes: u64,
    },
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    #[error(transparent)]
    Tuf(#[from] TufError),
    #[error(
        "this robot trusts no store yet; run `slag-edge trust add {from} --sha256 HEX` with the SHA-256 that `slag-encoder keys status` prints there, or fetch once with --trust-first to trust whoever answers there"
    )]
    NoTrust { from: String },
    #[error(
        "this robot began with another root, {held}, than the one offered, {offered}; to trust the latter in its place, add it with --replace"
    )]
    OtherRoot {
        /// SHA-256 of the root that was trusted first.
        held: String,
        offered: String,
    },
    #[error(
        "shard {hash} matches its hash but is not a valid shard of this scene; have the scene published again"
    )]
    Published { hash: Hash32, source: Box<StoreError> },
    #[error(transparent)]
    Plan(#[from] PlanError),
    #[error(
        "{path}: {free_bytes} bytes are free, the fetch needs {needed_bytes}; free some space, or fetch a smaller radius", path = path.display()
    )]
    NoSpace { path: PathBuf, needed_bytes: u64, free_bytes: u64 },
    #[error(
        "the disk is full: {source}; free up to {needed_bytes} bytes, or fetch a smaller radius (bytes received so far are kept)"
    )]
    DiskFull { needed_bytes: u64, source: io::Error },
    #[error("{0}; check the cache's folder and its permissions")]
    Io(#[from] io::Error),
    #[error("cancelled; fetch again to resume")]
    Cancelled,
}

fn what_next(failure: &DownloadFailure, kept_bytes: u64) -> String {
    let check = if failure.has_advice() { "" } else { "check the address and the connection, " };
    let kept = match kept_bytes {
        0 => String::new(),
        bytes => format!("; the {bytes} bytes of it that have arrived are kept"),
    };
    format!("; {check}then fetch again{kept}")
}

impl FetchError {
    /// Returns whether an operator's `trust` may fix it.
    pub(super) fn is_want_of_trust(&self) -> bool {
        match self {
            Self::NoTrust { .. } | Self::OtherRoot { .. } => true,
            Self::Records(e) => matches!(e, RecordsError::Damaged { .. }),
            Self::Tuf(e) => matches!(e, TufError::Signatures { .. } | TufError::Expired { .. }),
            _ => false,
        }
    }

    /// `kept_bytes`: of the file, for the next fetch to resume.
    pub(super) fn of_download(url: String, error: DownloadError, kept_bytes: u64) -> Self {
        match error {
            DownloadError::Failed { attempts, failure } => {
                Self::Download { url, attempts, failure, kept_bytes }
            }
            DownloadError::Io(e) => Self::Io(e),
            DownloadError::Cancelled => Self::Cancelled,
            DownloadError::TooLong { max_bytes } => TufError::TooLong { what: url, max_bytes }.into(),
        }
    }
}
