//! Objects of earlier generations, `history/GENERATION`, to compare generations after their shards are gone.
//!
//! A record is a container (`slag_common::container`) of JSON, vectors (`[n][dim]` i8) and their steps (`[n]` f32).
//! Without it, or if it is damaged, its generation is merely not compared.

use std::collections::BTreeMap;
use std::path::PathBuf;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};
use slag_common::frames::Aabb;
use slag_common::manifest::Manifest;
use slag_common::objects::{Place, Thing, is_unchanged, quantise_vectors};

use super::cache::EdgeCache;
use super::shard::OpenShard;

/// Newest generations kept.
pub const MAX_GENERATIONS: usize = 8;
/// Most objects kept of a generation: those of the cells nearest to the fetch's centre.
const MAX_THINGS: usize = 4096;
/// Most cells listed, with or without a shard; a generation with more is not recorded.
const MAX_CELLS: usize = 16_384;
/// A longer record is ignored: 4096 objects with 1,024 components and long names take less.
const MAX_BYTES: u64 = 8 << 20;
const MAGIC: [u8; 8] = *b"SLAGHIST";
const VERSION: u32 = 1;
const ABOUT: u32 = 1;
const VECTORS: u32 = 2;
const STEPS: u32 = 3;

/// The objects of a generation, and the cells whose objects are not known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    pub scene: String,
    pub generation: u64,
    pub created_unix_secs: u64,
    /// The space of the vectors.
    pub encoder_id: Hash32,
    /// Cells of the generation whose objects are not known, by id. Where no cell is, nothing is.
    missing: Vec<Missing>,
    /// Cells whose objects are known.
    #[serde(default)]
    places: Vec<Place>,
    /// The objects, by id.
    pub things: Vec<Thing>,
    dim: u32,
}

/// A cell whose objects are not known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Missing {
    cell_id: u32,
    bounds: Aabb,
}

impl Record {
    /// Collects one generation's objects, those nearest to `centre` if too many; `None`: none, or too much to record.
    pub fn collect<'a>(
        manifest: &Manifest,
        centre: DVec3,
        shards: impl IntoIterator<Item = &'a OpenShard>,
    ) -> Option<Self> {
        let distance = |of: &Aabb| of.min.max(centre.min(of.max)).distance_squared(centre);
        let with_objects = |shard: &&OpenShard| shard.additions().objects.is_some();
        let mut shards: Vec<&OpenShard> = shards.into_iter().filter(with_objects).collect();
        shards.sort_by(|a, b| {
            let by_distance = distance(&a.cell.bounds).total_cmp(&distance(&b.cell.bounds));
            by_distance.then(a.cell.cell_id.cmp(&b.cell.cell_id))
        });
        let (mut things, mut known, mut places) = (BTreeMap::new(), Vec::new(), Vec::new());
        for shard in shards {
            let Some(objects) = shard.additions().objects else { continue };
            if things.len() + objects.records.len() > MAX_THINGS {
                break;
            }
            Thing::add_all(&mut things, &shard.view(), &objects);
            known.push(shard.cell.cell_id);
            places.push(Place { bounds: shard.cell.bounds, splat: shard.view().splat_digest() });
        }
        known.sort_unstable();
        let missing = manifest.cells.iter().filter(|cell| known.binary_search(&cell.cell_id).is_err());
        let missing = missing.map(|cell| Missing { cell_id: cell.cell_id, bounds: cell.bounds });
        let record = Self {
            scene: manifest.scene.clone(),
            generation: manifest.generation,
            created_unix_secs: manifest.created_unix_secs,
            encoder_id: manifest.encoder.id,
            missing: missing.take(MAX_CELLS + 1).collect(),
            places,
            things: things.into_values().collect(),
            dim: manifest.encoder.dim,
        };
        let is_small = record.missing.len().max(known.len()) <= MAX_CELLS;
        (!known.is_empty() && is_small).then_some(record)
    }

    /// Adds another record of the same generation. If both are too much together, the newer one is kept.
    #[must_use]
    pub fn with(self, newer: Self) -> Self {
        let mut things: BTreeMap<u64, Thing> = self.things.into_iter().map(|of| (of.id, of)).collect();
        things.extend(newer.things.iter().cloned().map(|of| (of.id, of)));
        if things.len() > MAX_THINGS {
            return newer;
        }
        let is_in_both =
            |of: &Missing| newer.missing.binary_search_by_key(&of.cell_id, |other| other.cell_id).is_ok();
        let missing = self.missing.into_iter().filter(is_in_both).collect();
        let mut places = self.places;
        places
            .extend(newer.places.iter().filter(|place| !places.contains(place)).copied().collect::<Vec<_>>());
        Self { missing, places, things: things.into_values().collect(), ..newer }
    }

    /// Returns whether a thing of another generation that is missing here is gone: its box touches no cell with
    /// unknown objects, and the splat there is not the other's.
    pub fn tells_of(&self, thing: &Thing, other: &[Place]) -> bool {
        !self.missing.iter().any(|cell| cell.bounds.touches(&thing.box_in_world))
            && !is_unchanged(thing, other, &self.places)
    }

    pub fn places(&self) -> &[Place] {
        &self.places
    }

    pub fn to_bytes(&self) -> Vec<u8> {
        let about = serde_json::to_vec(self).expect("numbers and text become JSON");
        let (mut vectors, mut steps) = (Vec::new(), Vec::new());
        for thing in &self.things {
            let vector: Vec<f32> = thing.vector.iter().map(|v| *v as f32).collect();
            let (components, step) = quantise_vectors(&vector, self.dim as usize, 1);
            vectors.extend(components);
            steps.extend(step);
        }
        let sections: [(u32, &[u8]); 3] =
            [(ABOUT, &about), (VECTORS, container::bytes_of(&vectors)), (STEPS, container::bytes_of(&steps))];
        let mut bytes = Vec::new();
        container::write(&mut bytes, MAGIC, VERSION, &sections).expect("writes to memory");
        bytes
    }

    pub fn parse(bytes: &[u8]) -> Result<Self, ContainerError> {
        let bytes = AlignedBytes::copy_of(bytes);
        let layout = Layout::check(&bytes, MAGIC, VERSION)?;
        let about = layout.find(ABOUT).ok_or(ContainerError::Missing { id: ABOUT, name: "about" })?;
        let damaged = |what: String| ContainerError::Damaged { offset_bytes: about.start as u64, what };
        let mut record: Self =
            serde_json::from_slice(&bytes[about.clone()]).map_err(|e| damaged(e.to_string()))?;
        let (n, dim) = (record.things.len(), record.dim as usize);
        let len = n.checked_mul(dim).ok_or_else(|| damaged(format!("{n} things of {dim} components")))?;
        let vectors = layout.column::<i8>(VECTORS, "vectors", len)?;
        let steps = layout.column::<f32>(STEPS, "steps", n)?;
        if !record.things.is_sorted_by(|a, b| a.id < b.id) {
            return Err(damaged("the ids do not ascend".into()));
        }
        let vectors: &[i8] = bytemuck::cast_slice(&bytes[vectors]);
        let steps: &[f32] = bytemuck::cast_slice(&bytes[steps]);
        for ((thing, vector), step) in record.things.iter_mut().zip(vectors.chunks(dim.max(1))).zip(steps) {
            thing.vector = vector.iter().map(|v| f64::from(*v) * f64::from(*step)).collect();
        }
        Ok(record)
    }
}

pub fn dir(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("history")
}

pub fn path(cache: &EdgeCache, generation: u64) -> PathBuf {
    dir(cache).join(generation.to_string())
}

/// Returns the generations that have a record, ascending.
pub fn generations(cache: &EdgeCache) -> Vec<u64> {
    let names = cache.files().list(&dir(cache)).unwrap_or_default();
    let mut generations: Vec<u64> = names.iter().filter_map(|name| name.parse().ok()).collect();
    generations.sort_unstable();
    generations
}

/// Returns the record of a generation of a scene; `None` if missing, damaged, or of another scene.
pub fn read(cache: &EdgeCache, scene: &str, generation: u64) -> Option<Record> {
    let bytes = cache.files().read(&path(cache, generation), MAX_BYTES).ok()?;
    let record = Record::parse(&bytes).inspect_err(|e| {
        tracing::warn!("history of generation {generation}: {}", crate::error_line(e));
    });
    record.ok().filter(|record| record.scene == scene && record.generation == generation)
}
