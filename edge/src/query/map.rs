//! The area on board.

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::frames::{Aabb, GeoReference};

use super::frame::{FRAME, UNITS, unit};
use crate::store::{BadCell, Snapshot};

/// The area on board, its age, and what is missing.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Map")]
pub struct MapStatus {
    /// Name of the scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: &'static str,
    /// Unit of every position and length: `m`, or `world` if the scene is not metric.
    #[schemars(extend("enum" = UNITS))]
    pub unit: &'static str,
    /// Whether z points up.
    pub z_is_up: bool,
    /// Where the world frame lies on the earth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geo_reference: Option<GeoReference>,
    /// When the generation was made, Unix seconds.
    pub created_unix_secs: u64,
    /// Seconds since then; 0 if the clock is behind.
    pub age_secs: u64,
    /// Until when it is known to be the newest, Unix seconds: when the store's timestamp expires.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expires_unix_secs: Option<u64>,
    /// Whether it is past that.
    pub is_expired: bool,
    /// Centre of the area that was fetched.
    #[schemars(with = "[f64; 3]")]
    pub centre_in_world: DVec3,
    /// Its radius.
    pub radius: f64,
    /// Things on board.
    pub n_objects: usize,
    /// Gaussians on board.
    pub n_gaussians: u64,
    /// Cells on board.
    pub cells: Vec<MapCell>,
    /// Cells of the scene that are not on board: outside the area, or not fetched.
    pub missing: Vec<MissingCell>,
}

/// A cell on board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct MapCell {
    /// Its id.
    pub cell_id: u32,
    /// Smallest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Its Gaussians.
    pub n_gaussians: u32,
    /// The generation that it is of, which is older where the newest could not be fetched.
    pub generation: u64,
}

/// A cell that is not on board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct MissingCell {
    /// Its id.
    pub cell_id: u32,
    /// Smallest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Whether it lies within the area that was asked for, so that a fetch failed to bring it.
    pub is_wanted: bool,
}

impl MapStatus {
    /// Describes a snapshot. `now_unix_secs`: the clock. `expires_unix_secs`: when the store's timestamp expires.
    pub fn of(snapshot: &Snapshot, now_unix_secs: u64, expires_unix_secs: Option<u64>) -> Self {
        let Snapshot { current, manifest, .. } = snapshot;
        let bad = |cell_id: u32| -> Option<&BadCell> {
            snapshot.bad_cells.iter().find(|bad| bad.cell_id == cell_id)
        };
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
        Self {
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            frame: FRAME,
            unit: unit(manifest),
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
}
