//! Records the objects of shards that are about to go (`store/history.rs`). What fails here is logged, never the
//! fetch's failure.

use rayon::prelude::*;
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::error::FetchError;
use super::staging::put;
use crate::store::history::{self, MAX_GENERATIONS, Record};
use crate::store::{Current, CurrentCell, EdgeCache, OpenShard, beside_queries};

/// Records the objects of the generation on board: of all its cells if `next`, another manifest, follows, else of
/// those that leave. `manifest`: its own. `cells`: those that stay, by id.
pub fn note(cache: &EdgeCache, old: &Current, manifest: &Manifest, next: Hash32, cells: &[CurrentCell]) {
    let stays = |cell: &CurrentCell| {
        let at = cells.binary_search_by_key(&cell.cell_id, |other| other.cell_id);
        old.manifest_hash == next && at.is_ok_and(|at| cells[at].hash == cell.hash)
    };
    let leaving: Vec<CurrentCell> = old.cells.iter().filter(|cell| !stays(cell)).copied().collect();
    if leaving.is_empty() {
        return;
    }
    let open = |cell: &CurrentCell| OpenShard::open(cache, manifest, old.profile, cell).ok();
    let shards: Vec<OpenShard> = beside_queries(|| leaving.par_iter().filter_map(open).collect());
    let Some(record) = Record::collect(manifest, old.centre_in_world, &shards) else { return };
    drop(shards);
    if let Err(e) = write(cache, record) {
        tracing::warn!("the objects of generation {} are not remembered: {e}", manifest.generation);
    }
}

fn write(cache: &EdgeCache, record: Record) -> Result<(), FetchError> {
    let (scene, generation) = (record.scene.clone(), record.generation);
    let record = match history::read(cache, &scene, generation) {
        Some(before) => before.with(record),
        None => record,
    };
    cache.files().create_dir(&history::dir(cache))?;
    let mut known = history::generations(cache);
    // Numbers of another scene, and of a store that began anew, say nothing about this one's.
    known.retain(|of| {
        let is_kept = *of < generation && history::read(cache, &scene, *of).is_some();
        if !is_kept && *of != generation {
            cache.files().remove(&history::path(cache, *of)).ok();
        }
        is_kept
    });
    for oldest in &known[..(known.len() + 1).saturating_sub(MAX_GENERATIONS)] {
        cache.files().remove(&history::path(cache, *oldest))?;
    }
    put(cache, &record.to_bytes(), &history::path(cache, generation))
}

/// Removes all records: they may be lost, and a full disk needs the space. Returns whether there were any.
pub fn forget(cache: &EdgeCache) -> bool {
    let known = history::generations(cache);
    for generation in &known {
        cache.files().remove(&history::path(cache, *generation)).ok();
    }
    !known.is_empty()
}
