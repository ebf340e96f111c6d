//! The data that scores come from.

use serde::Serialize;

/// Which data scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// Codebook centroids alone: fastest, every score within the bound stated.
    Centroids,
    /// As `Exact`, but of shards with exact embeddings only those are read that the measured errors of codes,
    /// and of fine residuals, leave near the border of the answer. Nearly all of the exact answer, tens of times
    /// sooner; [`Search::measured_errors`] says how near its scores are.
    Measured,
    /// Rows, and for what they cannot decide the residual codes or exact embeddings of shards that carry
    /// them.
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
        found.ok_or_else(|| format!("{text:?} is no precision; there are: {}", names()))
    }
}
