//! Full-precision scores of a published field, for evaluation and trust, and the Gaussians that a query found: which
//! they are in the input splat file, where they lie, and themselves as a splat.

use std::collections::{BTreeMap, HashMap};

use glam::DVec3;
use serde::Serialize;
use slag_common::Gaussians;
use slag_common::manifest::{Calibration, CellRecord};
use slag_common::objects::object_score;
use slag_common::shard::Profile;
use slag_common::splat::ply::{Point, PointProperties};

use crate::lift::field::{read_field, read_regions};
use crate::objects::NONE;
use crate::store::{StoreError, StoreReader, StoredShard};
use slag_math::dot;

/// Largest relative f32 rounding of a coordinate: splat files keep means in f32.
const F32_ROUNDING: f64 = 1e-7;

#[derive(Clone, Debug)]
pub struct Scores {
    /// `[N]` in input order; NaN for a Gaussian without evidence or cell.
    pub cosines: Vec<f32>,
    /// `[N]`: evidence, the blending weight under masks summed over all views.
    pub total_weights: Vec<f32>,
}

pub fn scores(reader: &StoreReader, query: &[f32]) -> Result<Scores, StoreError> {
    check_dim(reader, query)?;
    let table = read_regions(reader)?;
    let region_scores = table.scores(query);
    let mut scores = Scores::unknown(reader);
    for cell in &reader.manifest().cells {
        let field = read_field(reader, cell.cell_id, cell.n_gaussians, table.len())?;
        let cosines = field.cosines(&region_scores);
        for ((index, cosine), weight) in field.input_indices.iter().zip(cosines).zip(&field.total_weights) {
            scores.set(cell.cell_id, *index, cosine, *weight)?;
        }
    }
    Ok(scores)
}

impl Scores {
    fn unknown(reader: &StoreReader) -> Self {
        let manifest = reader.manifest();
        let n = (manifest.n_gaussians + manifest.n_rejected) as usize;
        Self { cosines: vec![f32::NAN; n], total_weights: vec![0.0; n] }
    }

    fn set(&mut self, cell_id: u32, index: u32, cosine: f32, total_weight: f32) -> Result<(), StoreError> {
        let (at, n) = (index as usize, self.cosines.len());
        *self.cosines.get_mut(at).ok_or_else(|| no_gaussian(cell_id, index, n))? = cosine;
        self.total_weights[at] = total_weight;
        Ok(())
    }
}

fn no_gaussian(cell_id: u32, index: u32, n: usize) -> StoreError {
    StoreError::Failed(format!(
        "cell {cell_id}: Gaussian {index} of a scene of {n}; the store is damaged, encode again"
    ))
}

fn check_dim(reader: &StoreReader, query: &[f32]) -> Result<(), StoreError> {
    let encoder = &reader.manifest().encoder;
    let (expected, found) = (encoder.dim as usize, query.len());
    match found == expected {
        true => Ok(()),
        false => Err(StoreError::Failed(format!(
            "the query has {found} components, the store's embeddings {expected}; use the models it was encoded with ({})",
            encoder.name
        ))),
    }
}

/// Scores every Gaussian as decoded from a profile's shards, as on a robot that holds them. Total weights are zero:
/// shards do not keep them.
pub fn scores_of_shards(reader: &StoreReader, query: &[f32], profile: Profile) -> Result<Scores, StoreError> {
    check_dim(reader, query)?;
    let mut scores = Scores::unknown(reader);
    for cell in &reader.manifest().cells {
        let cell_id = cell.cell_id;
        let stored = shard_of(reader, cell, profile)?;
        let shard = stored.view();
        // All profiles have the same order, so the exact shard tells the indices.
        let exact = match shard.has_input_indices() {
            true => None,
            false => Some(shard_of(reader, cell, Profile::Exact)?),
        };
        let indexed = exact.as_ref().map_or(shard, StoredShard::view);
        for (at, cosine) in shard.scores(query).into_iter().enumerate() {
            let index = indexed.input_index(at);
            let index = index.ok_or_else(|| no_shard(cell_id, Profile::Exact))?;
            scores.set(cell_id, index, cosine as f32, 0.0)?;
        }
    }
    Ok(scores)
}

fn shard_of(reader: &StoreReader, cell: &CellRecord, profile: Profile) -> Result<StoredShard, StoreError> {
    reader.read_shard(cell.shards.get(&profile).ok_or_else(|| no_shard(cell.cell_id, profile))?)
}

fn no_shard(cell_id: u32, profile: Profile) -> StoreError {
    // Exact shards tell which Gaussian is which.
    let needed = if profile == Profile::Exact { String::new() } else { format!("{profile} and ") };
    StoreError::Failed(format!(
        "cell {cell_id} has no {profile} shard; encode again with {needed}exact in --profiles"
    ))
}

/// Share of an object's score in its Gaussians' scores. On generated scenes, up to a third changed little, and objects
/// alone were worse; on the labelled house with given masks, more was better.
const OBJECT_SHARE: f32 = 0.3;

/// Score, or threshold of scores, of a Gaussian in an object.
pub fn mixed(of_gaussian: f32, of_object: f32) -> f32 {
    (1.0 - OBJECT_SHARE) * of_gaussian + OBJECT_SHARE * of_object
}

/// A published scene's objects, as robots receive them.
#[derive(Clone, Debug)]
pub struct PublishedObjects {
    /// `[N]` in input order: the object, or [`NONE`].
    pub object_of: Vec<u32>,
    /// By object, ascending.
    pub ids: Vec<u64>,
    /// Of the text bank's scores over the objects.
    pub calibration: Calibration,
    /// `[n][n_vectors][dim]`.
    vectors: Vec<f32>,
    n_vectors: usize,
    dim: usize,
}

impl PublishedObjects {
    pub fn read(reader: &StoreReader) -> Result<Self, StoreError> {
        let none = "the store has no objects, or no exact shards that tell which Gaussians they have; encode again, without \
                    --no-objects and with exact in --profiles";
        Self::find(reader)?.ok_or_else(|| StoreError::Failed(none.into()))
    }

    /// `None` if the scene has no objects, or no exact shards to identify Gaussians by.
    pub fn find(reader: &StoreReader) -> Result<Option<Self>, StoreError> {
        let manifest = reader.manifest();
        let dim = manifest.encoder.dim as usize;
        let n = (manifest.n_gaussians + manifest.n_rejected) as usize;
        let mut id_of = vec![None; n];
        let mut vectors_of_id: BTreeMap<u64, Vec<f32>> = BTreeMap::new();
        let mut header = None;
        for cell in &manifest.cells {
            let cell_id = cell.cell_id;
            let Some(record) = cell.shards.get(&Profile::Exact) else { return Ok(None) };
            let stored = reader.read_shard(record)?;
            let Some(objects) = stored.objects() else { return Ok(None) };
            let shard = stored.view();
            let indices = shard.exact.map_or(&[][..], |exact| exact.input_indices);
            for (run, object) in objects.runs() {
                let id = object.map(|object| objects.records[object].id);
                for index in indices.get(run.start as usize..run.end as usize).unwrap_or_default() {
                    let found = id_of.get_mut(*index as usize);
                    *found.ok_or_else(|| no_gaussian(cell_id, *index, n))? = id;
                }
            }
            let n_vectors = objects.header.n_vectors as usize;
            let decoded = shard.object_vectors(&objects);
            for (record, vectors) in objects.records.iter().zip(decoded.chunks_exact(n_vectors * dim)) {
                let vectors = || vectors.iter().map(|v| *v as f32).collect();
                vectors_of_id.entry(record.id).or_insert_with(vectors);
            }
            header.get_or_insert(objects.header);
        }
        let Some(header) = header else { return Ok(None) };
        let ids: Vec<u64> = vectors_of_id.keys().copied().collect();
        let number =
            |id: Option<u64>| id.and_then(|id| ids.binary_search(&id).ok()).map_or(NONE, |at| at as u32);
        let object_of = id_of.into_iter().map(number).collect();
        Ok(Some(Self {
            object_of,
            ids,
            calibration: Calibration { score_mean: header.score_mean, score_spread: header.score_spread },
            vectors: vectors_of_id.into_values().flatten().collect(),
            n_vectors: header.n_vectors as usize,
            dim,
        }))
    }

    /// Score of each object with a unit query, see [`slag_common::objects::object_score`].
    pub fn scores(&self, query: &[f32]) -> Vec<f32> {
        let cosines: Vec<f32> = self.vectors.chunks_exact(self.dim).map(|v| dot(v, query)).collect();
        cosines.chunks_exact(self.n_vectors).map(object_score).collect()
    }

    /// Mixes each object's score into its Gaussians': the thing is judged as a whole, and where its shape is wrong the
    /// Gaussian's own score still decides.
    pub fn overlay(&self, of_objects: &[f32], cosines: &mut [f32]) {
        let of_gaussians = cosines.iter_mut().zip(&self.object_of).filter(|(_, object)| **object != NONE);
        of_gaussians.for_each(|(cosine, object)| {
            let of_object = of_objects[*object as usize];
            *cosine = if cosine.is_nan() { of_object } else { mixed(*cosine, of_object) };
        });
    }
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct Hit {
    pub index: u32,
    pub cosine: f32,
    /// Mean, world frame.
    pub position_in_world: DVec3,
}

impl Scores {
    /// The `n` best, by cosine, then by index.
    pub fn best(&self, n: usize) -> Vec<u32> {
        let mut order = self.matching(f32::NEG_INFINITY);
        order.truncate(n);
        order
    }

    /// Gaussians at or above a threshold, best first: by cosine, then by index.
    pub fn matching(&self, threshold: f32) -> Vec<u32> {
        // NaN compares false: a Gaussian without evidence matches nothing.
        let mut order: Vec<u32> =
            (0..self.cosines.len() as u32).filter(|i| self.cosines[*i as usize] >= threshold).collect();
        let cosine = |index: &u32| self.cosines[*index as usize];
        order.sort_by(|a, b| cosine(b).total_cmp(&cosine(a)).then(a.cmp(b)));
        order
    }
}

/// Input Gaussians with their positions, in the given order. Leaves out those whose index no shard knows; a scene with
/// exact shards or input indices has none of these.
pub fn located(reader: &StoreReader, scores: &Scores, indices: &[u32]) -> Result<Vec<Hit>, StoreError> {
    let mut positions: HashMap<u32, Option<DVec3>> = indices.iter().map(|index| (*index, None)).collect();
    if positions.is_empty() {
        return Ok(Vec::new());
    }
    for cell in &reader.manifest().cells {
        let Some(stored) = indexed_shard(reader, cell)? else { continue };
        let shard = stored.view();
        for at in 0..shard.header.n_gaussians as usize {
            if let Some(place) = shard.input_index(at).and_then(|index| positions.get_mut(&index)) {
                *place = Some(shard.position_in_world(at));
            }
        }
    }
    let hit = |index: &u32| {
        let position_in_world = positions.get(index).copied().flatten()?;
        Some(Hit { index: *index, cosine: scores.cosines[*index as usize], position_in_world })
    };
    Ok(indices.iter().filter_map(hit).collect())
}

fn indexed_shard(reader: &StoreReader, cell: &CellRecord) -> Result<Option<StoredShard>, StoreError> {
    for record in Profile::ALL.iter().filter_map(|profile| cell.shards.get(profile)) {
        let shard = reader.read_shard(record)?;
        if shard.view().has_input_indices() {
            return Ok(Some(shard));
        }
    }
    Ok(None)
}

/// Fails unless a store was encoded from this splat, perhaps in another frame: compares its number of Gaussians, and
/// some positions.
pub fn check_scene(reader: &StoreReader, scene: &Gaussians, hits: &[Hit]) -> Result<(), StoreError> {
    let manifest = reader.manifest();
    let expected = manifest.n_gaussians + manifest.n_rejected;
    if scene.len() as u64 != expected {
        return Err(StoreError::Failed(format!(
            "the splat has {} Gaussians, the store was encoded from one of {expected}; give that splat",
            scene.len()
        )));
    }
    let shards = manifest.cells.iter().flat_map(|cell| cell.shards.values());
    let error = shards.map(|shard| shard.position_error).fold(0.0, f64::max);
    let found = |hit: &Hit| scene.means_in_world[hit.index as usize];
    // Of the store and, in its units, of the splat.
    let rounding = |scale: f64, hit: &Hit| {
        F32_ROUNDING * (hit.position_in_world.abs().max_element() + found(hit).abs().max_element() / scale)
    };
    // `NaN <= x` is false: NaN matches nothing.
    let is_same = |hit: &Hit| {
        let off = (found(hit) - hit.position_in_world).abs().max_element();
        off <= 1.01 * error + rounding(1.0, hit)
    };
    let Some(Hit { index, position_in_world: expected, .. }) = hits.iter().find(|hit| !is_same(hit)) else {
        return Ok(());
    };
    // A similarity keeps the ratios of distances.
    let from = |from: &Hit, hit: &Hit| {
        (found(hit).distance(found(from)), hit.position_in_world.distance(from.position_in_world))
    };
    let first = &hits[0];
    let far = hits.iter().max_by(|a, b| from(first, a).1.total_cmp(&from(first, b).1)).unwrap_or(first);
    let scale = from(first, far).0 / from(first, far).1;
    let keeps = |hit: &Hit, other: &Hit| {
        let (found, expected) = from(other, hit);
        (found / scale - expected).abs() <= 8.0 * (error + rounding(scale, hit))
    };
    if hits.len() >= LEAST_TO_COMPARE && hits.iter().all(|hit| keeps(hit, first) && keeps(hit, far)) {
        return Ok(());
    }
    Err(StoreError::Failed(format!(
        "Gaussian {index} lies at {} in the splat, at {expected} in the store; give the splat that the store was encoded from",
        scene.means_in_world[*index as usize]
    )))
}

/// Positions that tell whether two splats are one in two frames.
const LEAST_TO_COMPARE: usize = 6;

/// A PLY of points with their ranks as answers.
pub(crate) fn points_ply(hits: &[Hit], comments: &[String]) -> Vec<u8> {
    let properties = PointProperties { question: false, shard_index: false, input_index: true };
    let mut file = properties.header(hits.len() as u64, comments).into_bytes();
    file.reserve_exact(hits.len() * properties.point_bytes());
    for (hit, answer) in hits.iter().zip(1..) {
        let point = Point {
            question: 0,
            answer,
            position_in_world: hit.position_in_world,
            score: hit.cosine,
            shard_index: (0, 0),
            input_index: hit.index,
        };
        properties.put(&point, &mut file);
    }
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: a Gaussian with an object, one without, and one without evidence of its own.
    #[test]
    fn gaussians_take_a_part_of_their_objects_score() {
        let objects = PublishedObjects {
            object_of: vec![1, NONE, 0],
            ids: vec![7, 9],
            calibration: Calibration { score_mean: 0.0, score_spread: 0.1 },
            vectors: vec![1.0, 0.0, 0.0, 1.0],
            n_vectors: 1,
            dim: 2,
        };
        let of_objects = objects.scores(&[0.6, 0.8]);
        assert_eq!(of_objects, [0.6, 0.8]);
        let mut cosines = [0.2, 0.3, f32::NAN];
        objects.overlay(&of_objects, &mut cosines);
        assert_eq!(cosines, [0.7 * 0.2 + 0.3 * 0.8, 0.3, 0.6]);
    }

    #[test]
    fn a_missing_shard_names_each_profile_once() {
        let message = |profile| no_shard(3, profile).to_string();
        assert!(message(Profile::Exact).ends_with("with exact in --profiles"), "{}", message(Profile::Exact));
        let compact = message(Profile::Compact);
        assert!(compact.ends_with("with compact and exact in --profiles"), "{compact}");
    }

    #[test]
    fn matches_are_ordered_by_cosine_then_index() {
        let cosines = vec![0.2, f32::NAN, 0.5, 0.5, 0.1, -0.3];
        let scores = Scores { total_weights: vec![0.0; 6], cosines };
        assert_eq!(scores.matching(0.2), [2, 3, 0]);
        assert_eq!(scores.best(4), [2, 3, 0, 4]);
        assert_eq!(scores.best(9).len(), 5);
        assert!(scores.matching(0.6).is_empty());
    }
}
