//! The best-scoring Gaussians, without scoring them all.

use glam::DVec3;
use rayon::prelude::*;

use super::cell::Cell;
use super::collect::{BINS, Cut, Gather, bin_of, edge_of, runs_inside};
use super::search::{Hit, Run, Search};

impl Search<'_> {
    /// Returns the `limit` best Gaussians that reach a threshold, best first: by score, then by distance from `near`,
    /// then by cell and index. The selection is exact with respect to the scores returned.
    pub fn best(&self, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        if limit == 0 {
            return Vec::new();
        }
        let has_detail = (0..self.shards.len()).any(|at| self.cell(at).is_some_and(|cell| cell.has_detail()));
        let cut = if has_detail {
            // Half as many again: members ranking last by their own scores are then not among the best.
            let enough = limit.saturating_add(limit / 2).saturating_add(1);
            let floor = self.centroid_score_at(enough, f32::NEG_INFINITY);
            let counted = self.count(threshold, floor.unwrap_or(f32::NEG_INFINITY));
            score_reached(&counted, limit).map(|score| score.max(threshold))
        } else {
            self.centroid_score_at(limit, threshold)
        };
        let found = self.collect(Cut { score: cut.unwrap_or(threshold), least: threshold }, true);
        self.rank(&found, limit, near)
    }

    /// Returns the highest centroid score such that centroids at or above it have `limit` members or more; `None` if
    /// too few centroids reach the threshold. Sorts only the centroids of the rank's bin, found by a histogram.
    fn centroid_score_at(&self, limit: usize, threshold: f32) -> Option<f32> {
        let cells: Vec<Cell<'_>> = (0..self.shards.len()).filter_map(|at| self.cell(at)).collect();
        let scores = |cell: &Cell<'_>| {
            let scores = cell.centroids.iter().copied().zip(0usize..);
            scores.filter(|(score, _)| *score >= threshold).collect::<Vec<_>>()
        };
        let count = |Cell { shard, filter, .. }: &Cell<'_>, centroid: usize| {
            let members =
                shard.centroid_starts[centroid] as usize..shard.centroid_starts[centroid + 1] as usize;
            match filter {
                None => members.len() as u64,
                filter => runs_inside(shard, filter.as_ref(), members).map(|of| of.len() as u64).sum(),
            }
        };
        let empty = || vec![0u64; BINS];
        let cells_at_a_time = cells.len().div_ceil(rayon::current_num_threads());
        let histogram = cells.par_iter().with_min_len(cells_at_a_time).fold(empty, |mut bins, cell| {
            scores(cell).into_iter().for_each(|(score, at)| bins[bin_of(score)] += count(cell, at));
            bins
        });
        let histogram = histogram.reduce(empty, |mut all, bins| {
            all.iter_mut().zip(bins).for_each(|(all, n)| *all += n);
            all
        });
        let mut n_better = 0;
        let bin = (0..BINS).rev().find(|bin| {
            let is_here = n_better + histogram[*bin] >= limit as u64;
            n_better += if is_here { 0 } else { histogram[*bin] };
            is_here
        })?;
        let of_bin = cells.par_iter().flat_map_iter(|cell| {
            let here = scores(cell).into_iter().filter(|(score, _)| bin_of(*score) == bin);
            here.map(|(score, at)| (score, count(cell, at)))
        });
        let mut of_bin: Vec<(f32, u64)> = of_bin.collect();
        of_bin.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
        let reached = of_bin.iter().find(|(_, count)| {
            n_better += count;
            n_better >= limit as u64
        });
        reached.map(|(score, _)| *score)
    }

    fn rank(&self, found: &[Gather], limit: usize, near: Option<DVec3>) -> Vec<Hit> {
        let mut by_cell: Vec<usize> = (0..self.shards.len()).collect();
        by_cell.sort_by_key(|at| self.shards[*at].header.cell_id);
        let runs: Vec<Run> = by_cell.iter().flat_map(|at| &found[*at].found.runs).copied().collect();
        // Equal scores keep the order of the runs, which is that of cells and indices.
        let key = |(run, place): (&Run, u64)| u64::from(!rising(run.score)) << 32 | place;
        let mut keys: Vec<u64> = runs.iter().zip(0..).map(key).collect();
        // All keys differ.
        keys.par_sort_unstable();
        let mut hits: Vec<Hit> = Vec::new();
        for ties in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
            let first = hits.len();
            for key in ties {
                let Run { shard, start, end, score } = runs[*key as u32 as usize];
                // All of them if distance breaks the tie.
                let capacity = if near.is_some() { usize::MAX } else { limit - hits.len() };
                let end = end.min(start.saturating_add(u32::try_from(capacity).unwrap_or(u32::MAX)));
                hits.extend((start..end).map(|index| Hit { shard, index, score }));
            }
            if let Some(near) = near {
                let mut tied: Vec<(f64, Hit)> =
                    hits.drain(first..).map(|hit| (self.distance(near, &hit), hit)).collect();
                // Stable sort: equally near hits stay in the order of cell and index.
                tied.sort_by(|a, b| a.0.total_cmp(&b.0));
                hits.extend(tied.iter().map(|(_, hit)| *hit).take(limit - first));
            }
            if hits.len() == limit {
                break;
            }
        }
        hits
    }

    fn distance(&self, from: DVec3, hit: &Hit) -> f64 {
        from.distance(self.shards[hit.shard as usize].position_in_world(hit.index as usize))
    }
}

/// Returns a score that at least `limit` of the counted Gaussians reach; `None` if there are fewer.
fn score_reached(counted: &[Gather], limit: usize) -> Option<f32> {
    let mut n = 0;
    let bin = (0..BINS).rev().find(|bin| {
        n += counted.iter().filter_map(|of| of.bins.get(*bin)).map(|n| u64::from(*n)).sum::<u64>();
        n >= limit as u64
    })?;
    Some(edge_of(bin))
}

/// Maps a score to an integer of the same order.
fn rising(score: f32) -> u32 {
    let bits = score.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Oracle: the standard library's order of floats.
    #[test]
    fn keys_and_bins_rise_with_scores() {
        let mut scores = vec![-1e30, -3.0, -1.0, -0.5, -1e-20, 0.0, 1e-20, 0.25, 0.9995, 1.0, 2.0, 1e30];
        let mut random = Random::new(32);
        scores.extend((0..3000).map(|_| random.signed()));
        scores.sort_by(f32::total_cmp);
        for pair in scores.windows(2) {
            assert!(rising(pair[0]) < rising(pair[1]) || pair[0] == pair[1]);
            assert!(bin_of(pair[0]) <= bin_of(pair[1]) && bin_of(pair[1]) < BINS);
        }
    }
}
