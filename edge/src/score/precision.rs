//! The data that scores come from.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::de::IntoDeserializer;
use serde::de::value::Error;
use serde::{Deserialize, Serialize};

/// The data that scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        Self::deserialize(text.into_deserializer())
    }
}
