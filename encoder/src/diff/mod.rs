//! What changed between two generations: things that appeared, went or moved, and the bytes that robots have to
//! fetch.
//!
//! [`changes`] says which things of two generations are the same.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use slag_common::Hash32;
use slag_common::objects::{Moved, Place, Thing, changes, is_unchanged};

use crate::store::{Published, StoreError, StoreReader};

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Diff {
    pub(crate) old_generation: u64,
    pub(crate) new_generation: u64,
    /// Whether lengths and positions are metres.
    pub(crate) metric: bool,
    /// Things of exactly the same Gaussians.
    pub(crate) n_same: usize,
    /// Things at the same place whose Gaussians changed.
    pub(crate) n_stayed: usize,
    /// Things that one generation alone has, where the splat is the same.
    pub(crate) n_not_compared: usize,
    /// Things of the later generation alone, by their ids.
    pub(crate) appeared: Vec<Thing>,
    /// Things of the earlier generation alone, by their ids.
    pub(crate) went: Vec<Thing>,
    /// Things that lie elsewhere, by the ids that they had.
    pub(crate) moved: Vec<Moved>,
    pub(crate) n_cells: usize,
    /// Those that have a shard which the earlier generation does not have.
    pub(crate) n_cells_changed: usize,
    /// Bytes of shards that a robot with the earlier generation has to fetch, by profile.
    pub(crate) fetch_bytes: BTreeMap<String, u64>,
}

pub(crate) fn diff(old: Generation<'_>, new: Generation<'_>) -> Result<Diff, StoreError> {
    let (old_manifest, manifest) = (&old.published.manifest, &new.published.manifest);
    if old_manifest.encoder.id != manifest.encoder.id {
        let [old, new] = [old_manifest, manifest].map(|m| format!("{} ({})", m.encoder.name, m.encoder.id));
        return Err(StoreError::NotComparable(format!(
            "the generations are of different encoders, {old} and {new}; encode one of them again with the other's models"
        )));
    }
    let ((old_things, old_places), (things, places)) = (read_things(old)?, read_things(new)?);
    let new_tells = |thing: &Thing| !is_unchanged(thing, &old_places, &places);
    let old_tells = |thing: &Thing| !is_unchanged(thing, &places, &old_places);
    let changes = changes(old_things, things, new_tells, old_tells);
    let known: BTreeSet<Hash32> = old.published.shard_lens().into_keys().collect();
    let mut fetch_bytes: BTreeMap<String, u64> = BTreeMap::new();
    let mut n_cells_changed = 0;
    for cell in &manifest.cells {
        n_cells_changed += usize::from(cell.shards.values().any(|shard| !known.contains(&shard.hash)));
        for (profile, shard) in &cell.shards {
            let bytes = fetch_bytes.entry(profile.to_string()).or_default();
            *bytes += if known.contains(&shard.hash) { 0 } else { shard.len_bytes };
        }
    }
    Ok(Diff {
        old_generation: old_manifest.generation,
        new_generation: manifest.generation,
        metric: manifest.metric && old_manifest.metric,
        n_same: changes.n_same,
        n_stayed: changes.n_stayed,
        n_not_compared: changes.n_not_compared,
        appeared: changes.appeared,
        went: changes.went,
        moved: changes.moved,
        n_cells: manifest.cells.len(),
        n_cells_changed,
        fetch_bytes,
    })
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Generation<'a> {
    pub(crate) reader: &'a StoreReader,
    /// The current generation or the one before it.
    pub(crate) published: &'a Published,
}

/// Reads objects by id, and cells, from the finest shards of each.
fn read_things(generation: Generation<'_>) -> Result<(Vec<Thing>, Vec<Place>), StoreError> {
    let manifest = &generation.published.manifest;
    let mut places = Vec::new();
    let mut things: BTreeMap<u64, Thing> = BTreeMap::new();
    for cell in &manifest.cells {
        let Some(shard) = cell.shards.values().next_back() else { continue };
        let shard = generation.reader.read_shard(shard)?;
        let no_objects = || {
            format!(
                "generation {} has no objects to compare; encode again, without --no-objects",
                manifest.generation
            )
        };
        let objects = shard.objects().ok_or_else(|| StoreError::NotComparable(no_objects()))?;
        Thing::add_all(&mut things, &shard.view(), &objects);
        places.push(Place { bounds: cell.bounds, splat: shard.view().splat_digest() });
    }
    Ok((things.into_values().collect(), places))
}

#[cfg(test)]
mod tests;
