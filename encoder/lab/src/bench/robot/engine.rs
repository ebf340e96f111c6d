//! What is timed.

use std::str::FromStr;

use slag_common::shard::Profile;

/// An engine, and the most Gaussians that it is given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Engine {
    /// A profile of `slag-edge`, or an engine of `edge/benches/rivals`.
    pub name: String,
    /// Sizes above this are left out.
    pub most_gaussians: Option<u64>,
}

impl Engine {
    /// Returns the profile whose shards `slag-edge` queries; `None` for other engines.
    pub fn profile(&self) -> Option<Profile> {
        Profile::ALL.into_iter().find(|profile| profile.name() == self.name)
    }

    /// Returns the memory that measuring a size takes, in bytes, or a little more. Other engines hold all vectors in f32;
    /// qdrant-edge holds them twice while it moves them into immutable segments.
    pub fn memory_bytes(&self, n_gaussians: u64, dim: u64) -> u64 {
        let vectors = n_gaussians * dim * 4;
        match self.name.as_str() {
            _ if self.profile().is_some() => n_gaussians * 100,
            name if name.starts_with("qdrant") => vectors * 23 / 10,
            name if name.ends_with("int8") => vectors / 2,
            _ => vectors * 12 / 10,
        }
    }
}

impl FromStr for Engine {
    type Err = String;

    /// Reads `NAME` or `NAME=MOST`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (name, most) = text.split_once('=').map_or((text, None), |(name, most)| (name, Some(most)));
        let most_gaussians = most.map(str::parse).transpose();
        let is_name = !name.is_empty()
            && name.chars().all(|c| c.is_ascii_lowercase() || c == '-' || c.is_ascii_digit());
        match most_gaussians {
            Ok(most_gaussians) if is_name => Ok(Self { name: name.to_owned(), most_gaussians }),
            _ => Err(format!("{text:?} is not NAME or NAME=GAUSSIANS, like qdrant-hnsw=1000000")),
        }
    }
}
