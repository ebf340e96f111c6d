//! The order of answers: by score, and with an asker, nearer ones first.

use glam::DVec3;
use slag_common::manifest::Manifest;

use super::request::QueryRequest;
use super::scene::default_voxel;

/// Distance, in default voxels, at which an answer's relevance is halved (10 m in a metric scene).
const VOXELS_TO_HALF_RELEVANCE: f64 = 40.0;

pub struct Order {
    /// The score of an unrelated thing.
    base: f32,
    half: f64,
    near: Option<DVec3>,
    limit: usize,
}

pub struct Ranked<T> {
    pub found: T,
    pub rank: usize,
    pub relevance: f32,
    pub distance: Option<f64>,
}

impl Order {
    pub fn new(base: f32, manifest: &Manifest, request: &QueryRequest) -> Self {
        let half = VOXELS_TO_HALF_RELEVANCE * default_voxel(manifest);
        Self { base, half, near: request.near, limit: request.n_ranked() }
    }

    /// Ranks answers, ties in their given order, and keeps as many as asked for. `key`: reported score and position.
    ///
    /// The ranking key, `(score - base) / (1 + distance / half)`, and 0 below `base`, depends neither on the threshold,
    /// which only filters, nor on another parameter. It is rounded to f32 to hide the last bits of a machine's division.
    pub fn rank<T>(&self, found: Vec<T>, key: impl Fn(&T) -> (f32, DVec3)) -> Vec<Ranked<T>> {
        let weighed = found.into_iter().map(|found| {
            let (score, position_in_world) = key(&found);
            let distance = self.near.map(|near| near.distance(position_in_world));
            let margin = (f64::from(score) - f64::from(self.base)).max(0.0);
            let relevance = (margin / (1.0 + distance.unwrap_or(0.0) / self.half)) as f32;
            (score, Ranked { found, rank: 0, relevance, distance })
        });
        let mut ranked: Vec<(f32, Ranked<T>)> = weighed.collect();
        ranked.sort_by(|(score, ranked), (other_score, other)| {
            let nearer = || ranked.distance.unwrap_or(0.0).total_cmp(&other.distance.unwrap_or(0.0));
            let by_relevance = other.relevance.total_cmp(&ranked.relevance);
            by_relevance.then(other_score.total_cmp(score)).then_with(nearer)
        });
        ranked.truncate(self.limit);
        ranked.into_iter().zip(1..).map(|((_, ranked), rank)| Ranked { rank, ..ranked }).collect()
    }
}
