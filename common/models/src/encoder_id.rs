//! The identity of an embedding space: vectors are comparable only if their encoder ids are equal.

use std::fmt;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Identifies an embedding space by everything that affects vectors, on the image and the text side.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderId {
    pub name: String,
    /// Components of a vector.
    pub dim: u32,
    /// The description of the model as JSON, with the SHA-256 of each file in place of its path and without the
    /// fields that do not affect vectors; empty for the built-in stand-in.
    pub definition: String,
}

impl EncoderId {
    /// Returns the SHA-256 of the id's canonical form: `slag-encoder-id 2`, a line feed, then the JSON array of
    /// name, dim and definition (a string) without spaces.
    pub fn hash(&self) -> [u8; 32] {
        let mut hasher = Sha256::new();
        hasher.update(b"slag-encoder-id 2\n");
        hasher.update(serde_json::json!([self.name, self.dim, self.definition]).to_string());
        hasher.finalize().into()
    }
}

/// Shows the name and the start of the hash.
impl fmt::Display for EncoderId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.name, hex::encode(&self.hash()[..6]))
    }
}
