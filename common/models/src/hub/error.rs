//! Errors of pulling models.

use std::{fmt, io};

use serde::{Deserialize, Serialize};

use crate::error::ModelError;

#[derive(Debug, thiserror::Error)]
pub enum HubError {
    #[error("{0}")]
    Other(String),
    #[error(
        "{name} is licensed under {licence} ({url}), which restricts its use{}; if you accept it, pull with \
         --accept-licence {licence}",
        if note.is_empty() { String::new() } else { format!("; note: {}", note.trim_end_matches('.')) }
    )]
    Licence { name: String, licence: String, url: String, note: String },
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("{0}; free disk space, or choose another folder with XDG_CACHE_HOME")]
    Io(#[from] io::Error),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The program's table of models.
    Table,
    /// The hub, which advertises it.
    Hub,
    /// Trust on first use: the hash of the first download.
    FirstPull,
    /// The hash of a file placed by hand.
    PlacedByHand,
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Table => "known to this program",
            Self::Hub => "advertised by the hub",
            Self::FirstPull => "as pulled first, see models.lock",
            Self::PlacedByHand => "as placed by hand, see models.lock",
        })
    }
}
