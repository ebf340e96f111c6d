//! The name of an embedding space: vectors may be compared where their encoder ids are equal.

use std::{collections::BTreeMap, fmt};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Names an embedding space by its model files, image and text side together.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderId {
    /// The name of the space.
    pub name: String,
    /// Components of a vector.
    pub dim: u32,
    /// SHA-256 of each file in hexadecimal, by role (`image.model`, `text.model` ...); empty for what is built in.
    pub sha256_of_file: BTreeMap<String, String>,
}

impl EncoderId {
    /// Returns the SHA-256 of the id's canonical form: `slag-encoder-id 1`, a line feed, then the
    /// JSON array of name, dim and files without spaces, roles in the order of their bytes.
    pub fn hash(&self) -> [u8; 32] {
        let mut hasher = Sha256::new();
        hasher.update(b"slag-encoder-id 1\n");
        hasher.update(serde_json::json!([self.name, self.dim, self.sha256_of_file]).to_string());
        hasher.finalize().into()
    }
}

/// Shows the name and the start of the hash, enough for a person to tell two apart.
impl fmt::Display for EncoderId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.name, hex::encode(&self.hash()[..6]))
    }
}
