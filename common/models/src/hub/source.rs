//! Where the expected hash of a file comes from.

use serde::{Deserialize, Serialize};

/// Whose word a hash is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The table that the program carries.
    Table,
    /// The hub, which advertised it.
    Hub,
    /// Nobody's: it is the hash of what came first.
    FirstPull,
    /// Nobody's: it is the hash of what lay there.
    PlacedByHand,
}
