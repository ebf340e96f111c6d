//! Assembles the next generation: the cells whose shards are on board, and what answers for the others.

use std::collections::BTreeMap;

use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::error::FetchError;
use super::offer::Offer;
use super::plan::{Plan, Wanted};
use crate::store::{self, BadCell, CellFault, Current, CurrentCell, EdgeCache, OldShard};

#[derive(Clone, Copy)]
pub struct Before<'a> {
    pub cache: &'a EdgeCache,
    pub current: Option<&'a Current>,
    pub offer: Option<&'a Offer>,
}

/// Returns the pointer to a new generation. `bad`: objects that could not be had.
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
    /// Returns a whole shard of an earlier generation that may answer for a cell of a new one.
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
        let read;
        let manifest = match self.offer.filter(|offer| offer.manifest_hash == old.manifest_hash) {
            Some(offer) => &offer.manifest,
            None => match self.cache.read_manifest(old.manifest_hash) {
                Ok(manifest) => {
                    read = manifest;
                    &read
                }
                Err(_) => return false,
            },
        };
        let path = self.cache.shard_path(old.hash);
        let cell = CurrentCell { cell_id, hash: old.hash, len_bytes: old.len_bytes };
        store::can_stand_in(manifest, new, cell_id)
            && store::check_file(self.cache, &path, &cell, wanted.profile, manifest).is_ok()
    }
}
