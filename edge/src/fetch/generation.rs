//! Assembles the next generation: cells with shards on board, and stand-ins for the others.

use std::collections::BTreeMap;

use rayon::prelude::*;
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::error::FetchError;
use super::offer::Offer;
use super::plan::{Plan, Wanted};
use super::staging::put;
use crate::store::history::{self, MAX_GENERATIONS, Record};
use crate::store::{
    self, BadCell, CellFault, Current, CurrentCell, EdgeCache, Listed, OldShard, OpenShard, beside_queries,
};

#[derive(Clone, Copy)]
pub struct Before<'a> {
    pub cache: &'a EdgeCache,
    pub current: Option<&'a Current>,
    pub offer: Option<&'a Offer>,
}

/// Returns the pointer to a new generation. `bad`: unavailable objects.
pub fn assemble(
    before: Before<'_>,
    offer: &Offer,
    wanted: &Wanted,
    plan: &Plan,
    bad: &BTreeMap<Hash32, (CellFault, FetchError)>,
) -> Current {
    let is_bad = |cell: &&CurrentCell| bad.contains_key(&cell.hash);
    let bad_cells = plan.cells.iter().filter_map(|cell| {
        let (fault, _) = bad.get(&cell.hash)?;
        let old = before.stand_in(&offer.manifest, wanted, cell.cell_id);
        Some(BadCell { cell_id: cell.cell_id, fault: *fault, old })
    });
    Current {
        manifest_hash: offer.manifest_hash,
        profile: wanted.profile,
        centre_in_world: wanted.centre_in_world,
        radius: wanted.radius,
        bad_cells: bad_cells.collect(),
        cells: plan.cells.iter().filter(|cell| !is_bad(cell)).copied().collect(),
    }
}

impl Before<'_> {
    /// Returns a whole shard of an earlier generation to stand in for a cell.
    fn stand_in(&self, new: &Manifest, wanted: &Wanted, cell_id: u32) -> Option<OldShard> {
        let current = self.current.filter(|current| current.profile == wanted.profile)?;
        let Current { manifest_hash, .. } = *current;
        let generation = self.offer.map(|offer| offer.manifest.generation);
        let of_current = current.cells.iter().filter_map(|cell| {
            let CurrentCell { hash, len_bytes, .. } = *cell;
            Some((cell.cell_id, OldShard { generation: generation?, manifest_hash, hash, len_bytes }))
        });
        let mut of_cell = of_current.chain(current.old_shards()).filter(|(id, _)| *id == cell_id);
        of_cell.find(|(_, old)| self.is_fit(old, new, wanted, cell_id)).map(|(_, old)| old)
    }

    fn is_fit(&self, old: &OldShard, new: &Manifest, wanted: &Wanted, cell_id: u32) -> bool {
        let Ok(manifest) = self.cache.read_manifest(old.manifest_hash) else { return false };
        let listed = Listed { manifest: &manifest, profile: wanted.profile, at: &old.of_cell(cell_id) };
        store::can_stand_in(&manifest, new, cell_id) && listed.check_file(self.cache).is_ok()
    }
}

/// Records the objects of the generation on board: of all cells if another manifest (`next`) follows, else of the
/// leaving ones. `manifest`: its own. `cells`: those that stay, by id.
pub fn remember(cache: &EdgeCache, old: &Current, manifest: &Manifest, next: Hash32, cells: &[CurrentCell]) {
    let stays = |cell: &CurrentCell| {
        let at = cells.binary_search_by_key(&cell.cell_id, |other| other.cell_id);
        old.manifest_hash == next && at.is_ok_and(|at| cells[at].hash == cell.hash)
    };
    let leaving: Vec<CurrentCell> = old.cells.iter().filter(|cell| !stays(cell)).copied().collect();
    if leaving.is_empty() {
        return;
    }
    let open = |at: &CurrentCell| Listed { manifest, profile: old.profile, at }.open(cache).ok();
    let shards: Vec<OpenShard> = beside_queries(|| leaving.par_iter().filter_map(open).collect());
    let Some(record) = Record::collect(manifest, old.centre_in_world, &shards) else { return };
    drop(shards);
    if let Err(e) = write_record(cache, record) {
        tracing::warn!("the objects of generation {} are not remembered: {e}", manifest.generation);
    }
}

fn write_record(cache: &EdgeCache, record: Record) -> Result<(), FetchError> {
    let (scene, generation) = (record.scene.clone(), record.generation);
    let record = match history::read(cache, &scene, generation) {
        Some(before) => before.with(record),
        None => record,
    };
    cache.create_dir(&history::dir(cache))?;
    let mut known = history::generations(cache);
    // Generation numbers of another scene, or of a restarted store, are not comparable.
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

/// Removes all earlier generations' records, which may be lost, to free space; returns whether there were any.
pub fn forget_earlier(cache: &EdgeCache) -> bool {
    let known = history::generations(cache);
    for generation in &known {
        cache.files().remove(&history::path(cache, *generation)).ok();
    }
    !known.is_empty()
}
