//! The order of answers.

use glam::DVec3;
use slag_common::manifest::Manifest;

use super::request::{DEFAULT_LIMIT, QueryRequest};
use super::scene::default_voxel;

/// Distance, in voxels, at which a cluster's relevance is halved (10 m in a metric scene).
const VOXELS_TO_HALF_RELEVANCE: f64 = 40.0;

/// Returns the ranking key of an answer: `(score - threshold) * ln(1 + n) / (1 + distance / half)`.
///
/// The score's margin, weighted by the number of Gaussians with diminishing effect, and halved at a distance
/// of `half` (40 voxels). Rounded to f32, so that the last bits of a machine's logarithm do not show.
pub fn relevance(score: f32, threshold: f32, n_gaussians: u64, distance: Option<f64>, half: f64) -> f32 {
    let margin = f64::from((score - threshold).max(0.0));
    (margin * (1.0 + n_gaussians as f64).ln() / (1.0 + distance.unwrap_or(0.0) / half)) as f32
}

/// An answer with its rank.
pub struct Ranked<T> {
    pub found: T,
    pub rank: usize,
    pub relevance: f32,
    pub distance: Option<f64>,
}

/// Ranks answers, keeps equals in their order, and returns as many as are asked for. `key`: score as
/// reported, number of Gaussians, and position.
pub fn rank<T>(
    found: Vec<T>,
    threshold: f32,
    manifest: &Manifest,
    request: &QueryRequest,
    key: impl Fn(&T) -> (f32, u64, DVec3),
) -> Vec<Ranked<T>> {
    let half = VOXELS_TO_HALF_RELEVANCE * request.voxel.unwrap_or_else(|| default_voxel(manifest));
    let weighed = found.into_iter().map(|found| {
        let (score, n_gaussians, at) = key(&found);
        let distance = request.near.map(|near| near.distance(at));
        let relevance = relevance(score, threshold, n_gaussians, distance, half);
        Ranked { found, rank: 0, relevance, distance }
    });
    let mut ranked: Vec<Ranked<T>> = weighed.collect();
    ranked.sort_by(|a, b| {
        let nearer = a.distance.unwrap_or(0.0).total_cmp(&b.distance.unwrap_or(0.0));
        b.relevance.total_cmp(&a.relevance).then(nearer)
    });
    ranked.truncate(request.limit.unwrap_or(DEFAULT_LIMIT));
    ranked.iter_mut().zip(1..).for_each(|(ranked, rank)| ranked.rank = rank);
    ranked
}
