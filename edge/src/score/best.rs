//! The best-scoring Gaussians, without scoring them all.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::DVec3;
use rayon::prelude::*;

use super::{F16_ROUNDING, Search, rounding_bound, runs_inside};

/// One Gaussian and its score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Position of the shard in the searched slice.
    pub shard: u32,
    /// Index in the shard.
    pub index: u32,
    /// Exact where the shard carries exact embeddings, else that of its row.
    pub score: f32,
    /// Its mean.
    pub position_in_world: DVec3,
    /// Distance from the point that ties are broken by; 0 without one.
    pub distance: f64,
}

/// A hit ordered so that the greatest is the worst: lower score, then farther, then later.
struct Worst(Hit);

impl Ord for Worst {
    fn cmp(&self, other: &Self) -> Ordering {
        let (a, b) = (&self.0, &other.0);
        b.score
            .total_cmp(&a.score)
            .then(a.distance.total_cmp(&b.distance))
            .then((a.shard, a.index).cmp(&(b.shard, b.index)))
    }
}

impl PartialOrd for Worst {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Worst {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Worst {}

impl Search<'_> {
    /// Returns the best Gaussians that reach a threshold, best first: by score, then by distance from
    /// `near`, then by shard and index. Rows are opened from the highest bound down, until no member
    /// of the next can be among the best.
    pub fn best(&self, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        let shards = (0..self.row_scores.len()).into_par_iter();
        let per_shard: Vec<Vec<Hit>> =
            shards.map(|shard| self.best_in(shard, limit, threshold, near)).collect();
        let mut all: Vec<Worst> = per_shard.into_iter().flatten().map(Worst).collect();
        all.sort_unstable();
        all.truncate(limit);
        all.into_iter().map(|Worst(hit)| hit).collect()
    }

    fn best_in(&self, shard_at: usize, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        let (Some(scores), true) = (&self.row_scores[shard_at], limit > 0) else { return Vec::new() };
        let shard = &self.shards[shard_at];
        let filter = self.filter(shard);
        let slack = |row: usize| match shard.exact {
            Some(_) => shard.radii[row] + rounding_bound(self.query.len()) + F16_ROUNDING,
            None => 0.0,
        };
        let mut rows: Vec<(f32, usize)> = scores
            .iter()
            .enumerate()
            .map(|(row, score)| (score + slack(row), row))
            .filter(|(upper, _)| *upper >= threshold)
            .collect();
        rows.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut best: BinaryHeap<Worst> = BinaryHeap::new();
        for (upper, row) in rows {
            if best.len() == limit && best.peek().is_some_and(|worst| upper < worst.0.score) {
                break;
            }
            for index in runs_inside(shard, filter, shard.members(row)).flatten() {
                let score = match &shard.exact {
                    Some(exact) => self.exact_score(exact.embeddings, index),
                    None => scores[row],
                };
                let full = best.len() == limit;
                if score < threshold || full && best.peek().is_some_and(|worst| score < worst.0.score) {
                    continue;
                }
                let position_in_world = shard.position_in_world(index);
                let distance = near.map_or(0.0, |near| near.distance(position_in_world));
                let (shard, index) = (shard_at as u32, index as u32);
                best.push(Worst(Hit { shard, index, score, position_in_world, distance }));
                if full {
                    best.pop();
                }
            }
        }
        best.into_iter().map(|Worst(hit)| hit).collect()
    }
}
