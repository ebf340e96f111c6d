//! Sources of the expected hash of a file.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The source of an expected hash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The program's table of models.
    Table,
    /// The hub, which advertises it.
    Hub,
    /// None: it is the hash of the first download.
    FirstPull,
    /// None: it is the hash of a file placed by hand.
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
