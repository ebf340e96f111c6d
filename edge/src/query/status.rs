//! Status of the loaded generation.

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_api::FRAME;
use slag_api::map::{MapCell, MapStatus, MissingCell};
use slag_common::Hash32;
use slag_common::frames::{Aabb, GeoReference};
use slag_common::shard::{Profile, ShardHeader};

use super::scene::unit;
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
        let shards = snapshot.shards.iter().map(|shard| {
            let ShardHeader { cell_id, n_gaussians, n_centroids, .. } = shard.view().header;
            ShardStatus { cell_id, n_gaussians, n_centroids, len_bytes: shard.len_bytes() }
        });
        let shards: Vec<ShardStatus> = shards.collect();
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

/// Describes a snapshot. `expires_unix_secs`: when the store's timestamp expires.
pub fn map_status(snapshot: &Snapshot, now_unix_secs: u64, expires_unix_secs: Option<u64>) -> MapStatus {
    let Snapshot { current, manifest, .. } = snapshot;
    let bad =
        |cell_id: u32| -> Option<&BadCell> { snapshot.bad_cells.iter().find(|bad| bad.cell_id == cell_id) };
    let generation = |cell_id| {
        let old = bad(cell_id).and_then(|bad| bad.old);
        old.map_or(manifest.generation, |old| old.generation)
    };
    let (mut cells, mut on_board) = (Vec::new(), Vec::new());
    for shard in &snapshot.shards {
        let view = shard.view();
        let (cell_id, Aabb { min, max }) = (view.header.cell_id, view.bounds());
        on_board.push(cell_id);
        cells.push(MapCell {
            cell_id,
            box_min_in_world: min,
            box_max_in_world: max,
            n_gaussians: view.header.n_gaussians,
            generation: generation(cell_id),
        });
    }
    on_board.sort_unstable();
    let missing = manifest.cells.iter().filter(|cell| on_board.binary_search(&cell.cell_id).is_err());
    let missing = missing.map(|cell| MissingCell {
        cell_id: cell.cell_id,
        box_min_in_world: cell.bounds.min,
        box_max_in_world: cell.bounds.max,
        is_wanted: bad(cell.cell_id).is_some(),
    });
    MapStatus {
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        frame: FRAME.into(),
        unit: unit(manifest).into(),
        z_is_up: manifest.metric || manifest.geo_reference.is_some(),
        geo_reference: manifest.geo_reference,
        created_unix_secs: manifest.created_unix_secs,
        age_secs: now_unix_secs.saturating_sub(manifest.created_unix_secs),
        expires_unix_secs,
        is_expired: expires_unix_secs.is_some_and(|expires| expires <= now_unix_secs),
        centre_in_world: current.centre_in_world,
        radius: current.radius,
        n_objects: snapshot.objects.len(),
        n_gaussians: cells.iter().map(|cell| u64::from(cell.n_gaussians)).sum(),
        cells,
        missing: missing.collect(),
    }
}
