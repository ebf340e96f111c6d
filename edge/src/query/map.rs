//! The area on board.

use slag_api::FRAME;
use slag_api::map::{MapCell, MapStatus, MissingCell};
use slag_common::frames::Aabb;

use super::scene::unit;
use crate::store::{BadCell, Snapshot};

/// Describes a snapshot. `now_unix_secs`: the clock. `expires_unix_secs`: when the store's timestamp expires.
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
