//! The records of a manifest, which are its JSON.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::frames::{Aabb, GeoReference};
use crate::hash::Hash32;
use crate::shard::{Profile, ScoreErrors};

/// Version of the manifest format that is written and read.
pub const VERSION: u32 = 2;
pub const TARGET: &str = "manifest";
pub const MAX_TEXT_FILES: usize = 16;
/// Largest manifest read: a cell takes about 600 bytes, so this allows 100,000 cells.
pub const MAX_BYTES: u64 = 64 << 20;

/// A list of the shards of one generation of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Format version.
    #[schemars(extend("const" = VERSION))]
    pub version: u32,
    /// Name of the scene.
    pub scene: String,
    /// Number of this encode of the scene, for people; the metadata's versions decide what is newer.
    pub generation: u64,
    /// When it was made, seconds since 1970.
    pub created_unix_secs: u64,
    /// Whether a world unit is a metre.
    pub metric: bool,
    /// Position of the world frame on the earth, if known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub geo_reference: Option<GeoReference>,
    /// The encoder that defines the space of the embeddings.
    pub encoder: EncoderRecord,
    /// Gaussians in all cells.
    pub n_gaussians: u64,
    /// Gaussians without an embedding: in no view, or under no mask.
    pub n_without_evidence: u64,
    /// Gaussians of the input that no cell holds, because a field is not finite or not valid.
    pub n_rejected: u64,
    /// The cells, by ascending id.
    pub cells: Vec<CellRecord>,
}

/// The encoder that made a scene's embeddings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EncoderRecord {
    /// Its name, for display.
    pub name: String,
    /// Its identity: a digest of name, dimension and the SHA-256 of its model files.
    pub id: Hash32,
    /// Components of an embedding.
    pub dim: u32,
    /// Cosine from which a Gaussian matches, unless the query or the calibration gives another.
    pub default_threshold: f32,
    /// Distribution of scores in this scene; present if the model states no threshold.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub calibration: Option<Calibration>,
    /// Its text side, if the store carries it.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub text_model: Option<TextModelRecord>,
}

/// The text side of an encoder as objects of the store.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TextModelRecord {
    /// The description in JSON, which names the files by their BLAKE3 hashes.
    pub description: ObjectRecord,
    /// The files, each once, in the order of the description.
    pub files: Vec<ObjectRecord>,
}

impl TextModelRecord {
    /// Returns all objects: the description, then the files.
    pub fn objects(&self) -> impl Iterator<Item = ObjectRecord> + '_ {
        std::iter::once(self.description).chain(self.files.iter().copied())
    }
}

/// An object that is no shard: an immutable file named by its hash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecord {
    /// BLAKE3 of the file.
    pub hash: Hash32,
    pub len_bytes: u64,
}

/// The distribution of the scores of a bank of texts in a scene.
///
/// Nearly all pairs of text and Gaussian do not match, so this is the distribution of non-matches in this scene
/// with this encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Mean of the scores of all pairs.
    pub score_mean: f32,
    /// Standard deviation of the scores of all pairs, not within a text.
    pub score_spread: f32,
}

/// A cell: a piece of space and its shards.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CellRecord {
    pub cell_id: u32,
    /// Box around the extents of its Gaussians, world frame.
    pub bounds: Aabb,
    pub n_gaussians: u32,
    /// Its shards, one per profile.
    #[schemars(extend("propertyNames" = serde_json::json!({ "enum": Profile::ALL.map(Profile::name) })))]
    pub shards: BTreeMap<Profile, ShardRecord>,
}

/// A shard: an immutable file named by its hash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ShardRecord {
    /// BLAKE3 of the file.
    pub hash: Hash32,
    pub len_bytes: u64,
    /// Centroids of the codebook.
    pub n_centroids: u32,
    /// Largest error of a score: the largest distance of an embedding from its decoded form.
    pub score_error_bound: f32,
    /// Errors of scores measured over a bank of texts.
    pub score_errors: ScoreErrors,
    /// Largest error of a position, world units.
    pub position_error: f64,
}
