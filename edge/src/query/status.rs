//! Status of the loaded generation.

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::frames::GeoReference;
use slag_common::shard::Profile;

use crate::store::{BadCell, Snapshot};

/// The scene on board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Scene")]
pub struct Status {
    /// Name of the scene.
    pub scene: String,
    /// Generation of the scene.
    pub generation: u64,
    /// BLAKE3 of the manifest.
    pub manifest_hash: Hash32,
    /// Name of the encoder that made the embeddings.
    pub encoder_name: String,
    /// Its id.
    pub encoder_id: Hash32,
    /// Default threshold: the least cosine of a match.
    pub default_threshold: f32,
    /// Profile of the shards.
    pub profile: Profile,
    /// Whether a world unit is a metre.
    pub metric: bool,
    /// Geographic reference of the world frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geo_reference: Option<GeoReference>,
    /// Centre of the last fetch.
    #[schemars(with = "[f64; 3]")]
    pub centre_in_world: DVec3,
    /// Radius of the last fetch, world units.
    pub radius: f64,
    /// Cells in the whole scene.
    pub n_cells_in_scene: usize,
    /// Cells within the radius whose shards could not be fetched.
    pub bad_cells: Vec<BadCell>,
    /// Gaussians on board.
    pub n_gaussians: u64,
    /// Bytes of the shards on board.
    pub len_bytes: u64,
    /// The shards on board.
    pub shards: Vec<ShardStatus>,
}

/// A shard on board.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ShardStatus {
    /// Its cell.
    pub cell_id: u32,
    /// Its Gaussians.
    pub n_gaussians: u32,
    /// Its codebook centroids.
    pub n_centroids: u32,
    /// Its length.
    pub len_bytes: u64,
}

impl Status {
    pub fn of(snapshot: &Snapshot) -> Self {
        let Snapshot { current, manifest, .. } = snapshot;
        let shards: Vec<ShardStatus> = snapshot
            .shards
            .iter()
            .map(|shard| {
                let header = shard.view().header;
                let (cell_id, len_bytes) = (header.cell_id, shard.len_bytes());
                ShardStatus {
                    cell_id,
                    n_gaussians: header.n_gaussians,
                    n_centroids: header.n_centroids,
                    len_bytes,
                }
            })
            .collect();
        Self {
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            manifest_hash: current.manifest_hash,
            encoder_name: manifest.encoder.name.clone(),
            encoder_id: manifest.encoder.id,
            default_threshold: manifest.encoder.default_threshold,
            profile: current.profile,
            metric: manifest.metric,
            geo_reference: manifest.geo_reference,
            centre_in_world: current.centre_in_world,
            radius: current.radius,
            n_cells_in_scene: manifest.cells.len(),
            bad_cells: snapshot.bad_cells.clone(),
            n_gaussians: shards.iter().map(|shard| u64::from(shard.n_gaussians)).sum(),
            len_bytes: shards.iter().map(|shard| shard.len_bytes).sum(),
            shards,
        }
    }
}
