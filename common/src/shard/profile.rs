//! Profiles: the sizes in which a cell is published.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The amount of data that a shard carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Centroids and positions.
    Compact,
    /// Centroids, positions and a residual code of each embedding.
    Balanced,
    /// Centroids, positions and every embedding as f16.
    Exact,
}

impl Profile {
    /// Every profile, smallest first.
    pub const ALL: [Self; 3] = [Self::Compact, Self::Balanced, Self::Exact];

    /// Returns the name used in manifests, URLs and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Compact => "compact",
            Self::Balanced => "balanced",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Profile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Profile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|p| p.name() == text)
            .ok_or_else(|| format!("{text:?} is not a profile; use one of {}", names()))
    }
}
