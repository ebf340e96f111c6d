//! The smallest shard of a cell, and scores of questions with negatives.

use glam::DVec3;
use slag_common::manifest::CellRecord;
use slag_math::relevancy::relevancy;
use slag_view::Photo;

use crate::store::{StoreError, StoreReader, StoredShard};

pub(super) fn photos_of(shard: &StoredShard) -> Vec<Photo> {
    let origin = DVec3::from(shard.layout.header.origin_in_world);
    let photos = shard.layout.additions(&shard.bytes).photo_poses;
    photos.into_iter().flat_map(|photos| Photo::of_shard(origin, photos)).collect()
}

/// Score of each Gaussian's centroid; NaN without one.
pub(super) fn scores_of(shard: &StoredShard, vectors: &[Vec<f32>]) -> Vec<f32> {
    let view = shard.view();
    let of_centroids =
        combined(vectors.iter().map(|vector| view.centroid_scores(vector)).collect(), f32::NEG_INFINITY);
    let mut scores = vec![f32::NAN; view.header.n_gaussians as usize];
    for (centroid, score) in of_centroids.iter().enumerate() {
        scores[view.members(centroid)].fill(*score);
    }
    scores
}

/// Combines a question's scores with its negatives', which are at least `least`, into the relevancy (LERF, Kerr et al.
/// 2023, section 3.3); without negatives, the question's own.
pub(super) fn combined(mut of_vectors: Vec<Vec<f32>>, least: f32) -> Vec<f32> {
    let mut own = of_vectors.swap_remove(0);
    if !of_vectors.is_empty() {
        for (k, score) in own.iter_mut().enumerate() {
            let closest = of_vectors.iter().map(|of| of[k]).fold(least, f32::max);
            *score = if score.is_nan() { f32::NAN } else { relevancy(*score - closest) };
        }
    }
    own
}

pub(super) fn smallest_shard(
    reader: &StoreReader,
    cell: &CellRecord,
) -> Result<Option<StoredShard>, StoreError> {
    cell.shards.values().next().map(|record| reader.read_shard(record)).transpose()
}

/// A cell's smallest shard with appearance, or else the smallest. All have the same order of Gaussians.
pub(super) fn smallest_with_appearance(
    reader: &StoreReader,
    cell: &CellRecord,
) -> Result<Option<StoredShard>, StoreError> {
    let mut smallest = None;
    for record in cell.shards.values() {
        let shard = reader.read_shard(record)?;
        if shard.layout.additions(&shard.bytes).appearance.is_some() {
            return Ok(Some(shard));
        }
        smallest.get_or_insert(shard);
    }
    Ok(smallest)
}
