//! The objects of a generation, as its shards carry them.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::Serialize;
use slag_common::container::ContainerError;
use slag_common::frames::Aabb;
use slag_common::shard::ShardLayout;

use crate::store::{Published, StoreError, StoreReader};

/// A generation of a store.
#[derive(Clone, Copy, Debug)]
pub struct Generation<'a> {
    /// The store.
    pub reader: &'a StoreReader,
    /// Its current generation or the one before it.
    pub published: &'a Published,
}

/// Two generations cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum DiffError {
    /// A shard cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A shard is damaged.
    #[error("cell {cell_id}: {source}; encode again: what is damaged is written anew")]
    Shard {
        /// The cell.
        cell_id: u32,
        /// The damage.
        source: ContainerError,
    },
    /// A generation was published without objects.
    #[error("generation {generation} has no objects to compare; encode again, without --no-objects")]
    NoObjects {
        /// The generation.
        generation: u64,
    },
    /// The vectors of the generations do not compare.
    #[error(
        "the generations are of different encoders, {old} and {new}; encode one of them again with the other's models"
    )]
    Encoders {
        /// The earlier generation's encoder.
        old: String,
        /// The later one's.
        new: String,
    },
}

/// An object of a generation.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Thing {
    /// Derived from the indices of its Gaussians in the splat: equal while these are the same.
    #[serde(serialize_with = "as_hex")]
    pub id: u64,
    /// Its Gaussians.
    pub n_gaussians: u32,
    /// Mean of its Gaussians inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile of its means along each axis.
    pub box_in_world: Aabb,
    /// Name of the view that shows it best.
    pub photo: String,
    /// `[dim]`: the mean of its masks' vectors, as a shard stores it.
    #[serde(skip)]
    pub vector: Vec<f64>,
}

fn as_hex<S: serde::Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    // JSON numbers have 53 bits.
    serializer.collect_str(&format_args!("{id:016x}"))
}

/// Reads the objects of a generation from the finest shards of each cell, by id.
pub(super) fn read(generation: Generation<'_>) -> Result<Vec<Thing>, DiffError> {
    let manifest = &generation.published.manifest;
    let mut things: BTreeMap<u64, Thing> = BTreeMap::new();
    for cell in &manifest.cells {
        let Some(shard) = cell.shards.values().next_back() else { continue };
        let bytes = generation.reader.read_object(shard.hash)?;
        let layout = ShardLayout::check(&bytes)
            .map_err(|source| DiffError::Shard { cell_id: cell.cell_id, source })?;
        let no_objects = DiffError::NoObjects { generation: manifest.generation };
        let objects = layout.objects(&bytes).ok_or(no_objects)?;
        let shard = layout.view(&bytes);
        let len = objects.header.n_vectors as usize * shard.header.dim as usize;
        let vectors = shard.object_vectors(&objects);
        for (record, vectors) in objects.records.iter().zip(vectors.chunks_exact(len.max(1))) {
            things.entry(record.id).or_insert_with(|| Thing {
                id: record.id,
                n_gaussians: record.n_gaussians,
                position_in_world: record.position(),
                box_in_world: record.bounds(),
                photo: objects.photo(record).to_owned(),
                vector: vectors[..shard.header.dim as usize].to_vec(),
            });
        }
    }
    Ok(things.into_values().collect())
}
