//! The objects of a generation, as its shards carry them.

use std::collections::BTreeMap;

use slag_common::objects::{Place, Thing};

use crate::store::{Published, StoreError, StoreReader};

#[derive(Clone, Copy, Debug)]
pub(crate) struct Generation<'a> {
    pub(crate) reader: &'a StoreReader,
    /// Its current generation or the one before it.
    pub(crate) published: &'a Published,
}

/// Two generations cannot be compared.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DiffError {
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("generation {generation} has no objects to compare; encode again, without --no-objects")]
    NoObjects { generation: u64 },
    #[error(
        "the generations are of different encoders, {old} and {new}; encode one of them again with the other's models"
    )]
    Encoders { old: String, new: String },
}

/// Reads the objects of a generation, by id, and its cells, from the finest shards of each.
pub(super) fn read(generation: Generation<'_>) -> Result<(Vec<Thing>, Vec<Place>), DiffError> {
    let manifest = &generation.published.manifest;
    let mut places = Vec::new();
    let mut things: BTreeMap<u64, Thing> = BTreeMap::new();
    for cell in &manifest.cells {
        let Some(shard) = cell.shards.values().next_back() else { continue };
        let shard = generation.reader.read_shard(shard)?;
        let no_objects = DiffError::NoObjects { generation: manifest.generation };
        let objects = shard.objects().ok_or(no_objects)?;
        Thing::add_all(&mut things, &shard.view(), &objects);
        places.push(Place { bounds: cell.bounds, splat: shard.view().splat_digest() });
    }
    Ok((things.into_values().collect(), places))
}
