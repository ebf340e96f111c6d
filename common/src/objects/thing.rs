//! The objects of a generation as things that are compared between generations.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use super::columns::Objects;
use crate::frames::Aabb;
use crate::shard::ShardView;

/// An object of a generation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Thing {
    /// Derived from the indices of its Gaussians in the splat: equal while these are the same.
    #[serde(serialize_with = "as_hex", deserialize_with = "from_hex")]
    pub id: u64,
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

/// Returns an object's id as answers name it: `o` and 16 hex digits.
pub fn public_id(id: u64) -> String {
    format!("o{id:016x}")
}

fn as_hex<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    // JSON numbers have 53 bits.
    serializer.collect_str(&format_args!("{id:016x}"))
}

fn from_hex<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    let text = String::deserialize(deserializer)?;
    u64::from_str_radix(&text, 16).map_err(de::Error::custom)
}

impl Thing {
    /// Adds the objects of a shard to a generation's things, by id; of an object in several shards, the first is
    /// taken.
    pub fn add_all(things: &mut BTreeMap<u64, Self>, shard: &ShardView<'_>, objects: &Objects<'_>) {
        let dim = shard.header.dim as usize;
        let len = objects.header.n_vectors as usize * dim;
        let vectors = shard.object_vectors(objects);
        for (record, vectors) in objects.records.iter().zip(vectors.chunks_exact(len.max(1))) {
            things.entry(record.id).or_insert_with(|| Self {
                id: record.id,
                n_gaussians: record.n_gaussians,
                position_in_world: record.position(),
                box_in_world: record.bounds(),
                photo: objects.photo(record).to_owned(),
                vector: vectors[..dim].to_vec(),
            });
        }
    }
}
