//! The best-scoring Gaussians, without scoring them all.

use std::cmp::Ordering;

use glam::DVec3;
use rayon::prelude::*;

use super::{Run, Search, runs_inside};

/// One Gaussian and its score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Position of the shard in the searched slice.
    pub shard: u32,
    /// Index in the shard.
    pub index: u32,
    /// Exact where the shard carries exact embeddings and they were asked for, else that of its row.
    pub score: f32,
}

impl Search<'_> {
    /// Returns the `limit` best Gaussians that reach a threshold, best first: by score, then by distance
    /// from `near`, then by cell and index. The selection is exact with respect to the scores returned.
    pub fn best(&self, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        if limit == 0 {
            return Vec::new();
        }
        let cut = self.score_surely_reached(limit, threshold);
        let mut runs = self.collect(cut, true).runs;
        runs.par_sort_unstable_by(|a, b| b.score.total_cmp(&a.score).then(self.by_name(a.shard, a.start, b)));
        let mut best = Vec::new();
        for ties in runs.chunk_by(|a, b| a.score == b.score) {
            let first = best.len();
            let hits = ties.iter().flat_map(|run| {
                (run.start..run.end).map(|index| Hit { shard: run.shard, index, score: run.score })
            });
            match near {
                // Ties are in the order of their names already.
                None => best.extend(hits.take(limit - first)),
                Some(near) => {
                    let mut tied: Vec<(f64, Hit)> =
                        hits.map(|hit| (self.distance(near, &hit), hit)).collect();
                    // Stable: those as near stay in the order of their names.
                    tied.sort_by(|a, b| a.0.total_cmp(&b.0));
                    best.extend(tied.into_iter().map(|(_, hit)| hit).take(limit - first));
                }
            }
            if best.len() == limit {
                break;
            }
        }
        best
    }

    fn distance(&self, from: DVec3, hit: &Hit) -> f64 {
        from.distance(self.shards[hit.shard as usize].position_in_world(hit.index as usize))
    }

    fn by_name(&self, shard: u32, start: u32, other: &Run) -> Ordering {
        let cell = |shard: u32| self.shards[shard as usize].header.cell_id;
        (cell(shard), start).cmp(&(cell(other.shard), other.start))
    }

    /// Returns a score, at least the threshold, that `limit` Gaussians surely reach; the threshold where
    /// there are no more that surely reach it.
    fn score_surely_reached(&self, limit: usize, threshold: f32) -> f32 {
        let per_shard = (0..self.shards.len()).into_par_iter().map(|at| {
            let (shard, Some(scores)) = (&self.shards[at], &self.row_scores[at]) else { return Vec::new() };
            let (filter, slack) = (self.filter(shard), self.slack(shard));
            let lower = scores.iter().enumerate().map(|(row, score)| (score - slack(row), row));
            lower
                .filter(|(lower, _)| *lower >= threshold)
                .map(|(lower, row)| {
                    (lower, runs_inside(shard, filter, shard.members(row)).map(|r| r.len()).sum())
                })
                .collect::<Vec<(f32, usize)>>()
        });
        let mut rows: Vec<(f32, usize)> = per_shard.flatten_iter().collect();
        rows.par_sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
        let mut n = 0;
        let reached = rows.into_iter().find(|(_, n_members)| {
            n += n_members;
            n >= limit
        });
        reached.map_or(threshold, |(lower, _)| lower)
    }
}
