//! The data that scores come from.

use schemars::JsonSchema;
use serde::Serialize;

/// The data that scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Codebook centroids only: fastest; every score is within the stated bound.
    Centroids,
    /// As `Exact`, but in shards with exact embeddings reads only those that the measured errors of codes and fine
    /// residuals leave undecided. Finds nearly all of the exact answer, tens of times faster; answers state the
    /// likely errors of its scores.
    Measured,
    /// Centroids, and where they cannot decide, the shard's exact embeddings or residual codes.
    #[default]
    Exact,
}

impl Precision {
    /// Every precision, fastest first.
    pub const ALL: [Self; 3] = [Self::Centroids, Self::Measured, Self::Exact];

    /// Returns the name used in URLs and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Centroids => "centroids",
            Self::Measured => "measured",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Precision {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|precision| precision.name() == text);
        found.ok_or_else(|| format!("{text:?} is not a precision; choose one of {}", names()))
    }
}
