//! The Gaussians that a query found: which they are in the input splat file, where they lie, and themselves as a
//! splat.

use std::collections::HashMap;

use glam::DVec3;
use serde::Serialize;
use slag_common::Gaussians;
use slag_common::manifest::CellRecord;
use slag_common::shard::Profile;
use slag_common::splat::ply::{Point, PointProperties};

use super::{QueryError, Scores};
use crate::store::{StoreReader, StoredShard};

/// Largest relative f32 rounding of a coordinate: splat files keep means in f32.
const F32_ROUNDING: f64 = 1e-7;

#[derive(Clone, Copy, Debug, Serialize)]
pub struct Hit {
    pub index: u32,
    pub cosine: f32,
    /// Mean, world frame.
    pub position_in_world: DVec3,
}

/// The splat is not the one that the store was encoded from.
#[derive(Debug, thiserror::Error)]
pub enum SceneMismatch {
    #[error("the splat has {found} Gaussians, the store was encoded from one of {expected}; give that splat")]
    Count { expected: u64, found: usize },
    #[error(
        "Gaussian {index} lies at {found} in the splat, at {expected} in the store; give the splat that the store was encoded from"
    )]
    Position { index: u32, expected: DVec3, found: DVec3 },
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
pub fn located(reader: &StoreReader, scores: &Scores, indices: &[u32]) -> Result<Vec<Hit>, QueryError> {
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

fn indexed_shard(reader: &StoreReader, cell: &CellRecord) -> Result<Option<StoredShard>, QueryError> {
    for record in Profile::ALL.iter().filter_map(|profile| cell.shards.get(profile)) {
        let shard = reader.read_shard(record)?;
        if shard.view().has_input_indices() {
            return Ok(Some(shard));
        }
    }
    Ok(None)
}

/// Fails unless a store was encoded from this splat: compares its number of Gaussians, and some positions.
pub fn check_scene(reader: &StoreReader, scene: &Gaussians, hits: &[Hit]) -> Result<(), SceneMismatch> {
    let manifest = reader.manifest();
    let expected = manifest.n_gaussians + manifest.n_rejected;
    if scene.len() as u64 != expected {
        return Err(SceneMismatch::Count { expected, found: scene.len() });
    }
    let shards = manifest.cells.iter().flat_map(|cell| cell.shards.values());
    let error = shards.map(|shard| shard.position_error).fold(0.0, f64::max);
    for Hit { index, position_in_world: expected, .. } in hits {
        let found = scene.means_in_world[*index as usize];
        let rounding = F32_ROUNDING * expected.abs().max_element();
        // `NaN <= x` is false: NaN matches nothing.
        let is_same = (found - *expected).abs().max_element() <= 1.01 * error + rounding;
        if !is_same {
            return Err(SceneMismatch::Position { index: *index, expected: *expected, found });
        }
    }
    Ok(())
}

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
