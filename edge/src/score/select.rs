//! The best-scoring Gaussians, without scoring them all.

use glam::DVec3;
use rayon::prelude::*;

use super::cell::Cell;
use super::centroids::AskedQuestion;
use super::collect::{BINS, Cut, Gather, bin_of, edge_of, runs_inside};
use super::matches::{Hit, Run};

#[derive(Default)]
pub(super) struct AnswerBuffers {
    pub gather: Gather,
    order: Order,
}

#[derive(Default)]
struct Order {
    parts: Vec<Part>,
    runs: Vec<Run>,
    keys: Vec<u64>,
    tied: Vec<(f64, Hit)>,
}

/// Counters of one counting thread.
#[derive(Default)]
struct Part {
    bins: Vec<u64>,
    in_bin: Vec<(f32, u64)>,
}

impl AskedQuestion<'_> {
    pub(super) fn best(
        &self,
        buffers: &mut AnswerBuffers,
        limit: usize,
        threshold: f32,
        near: Option<DVec3>,
    ) -> Vec<Hit> {
        let mut hits = Vec::new();
        if limit == 0 {
            return hits;
        }
        let AnswerBuffers { gather, order } = buffers;
        let has_detail = (0..self.shards.len()).any(|at| self.cell(at).is_some_and(|cell| cell.has_detail()));
        let cut = if has_detail {
            // Half as many again: members ranking last by their own scores are then not among the best.
            let enough = limit.saturating_add(limit / 2).saturating_add(1);
            let floor = self.centroid_score_at(order, enough, f32::NEG_INFINITY);
            self.count(gather, threshold, floor.unwrap_or(f32::NEG_INFINITY));
            score_reached(gather, limit).map(|score| score.max(threshold))
        } else {
            self.centroid_score_at(order, limit, threshold)
        };
        self.collect(gather, Cut { score: cut.unwrap_or(threshold), least: threshold }, true);
        self.rank(gather, order, limit, near, &mut hits);
        hits
    }

    /// Returns the highest centroid score such that centroids at or above it have `limit` members or more; `None` if
    /// too few centroids reach the threshold.
    fn centroid_score_at(&self, order: &mut Order, limit: usize, threshold: f32) -> Option<f32> {
        let cells: Vec<Option<Cell<'_>>> = (0..self.shards.len()).map(|at| self.cell(at)).collect();
        let scores = |at: usize| {
            let centroids = cells[at].as_ref().map_or(&[][..], |cell| cell.centroids);
            centroids.iter().copied().zip(0..).filter(move |(score, _)| *score >= threshold)
        };
        let count = |at: usize, centroid: usize| {
            let shard = &self.shards[at];
            let members =
                shard.centroid_starts[centroid] as usize..shard.centroid_starts[centroid + 1] as usize;
            match cells[at].as_ref().and_then(|cell| cell.filter.as_ref()) {
                None => members.len() as u64,
                filter => runs_inside(shard, filter, members).map(|inside| inside.len() as u64).sum(),
            }
        };
        order.score_at(limit, self.shards.len(), scores, count)
    }

    fn rank(
        &self,
        gather: &Gather,
        order: &mut Order,
        limit: usize,
        near: Option<DVec3>,
        hits: &mut Vec<Hit>,
    ) {
        let Order { runs, keys, tied, .. } = order;
        let mut by_cell: Vec<usize> = (0..self.shards.len()).collect();
        by_cell.sort_by_key(|at| self.shards[*at].header.cell_id);
        runs.clear();
        by_cell.iter().for_each(|at| runs.extend_from_slice(&gather.shards[*at].found.runs));
        keys.clear();
        // Equal scores keep the order of the runs, which is that of cells and indices.
        keys.extend(runs.iter().zip(0u64..).map(|(run, place)| u64::from(!rising(run.score)) << 32 | place));
        // All keys differ.
        keys.par_sort_unstable();
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
                tied.clear();
                tied.extend(hits.drain(first..).map(|hit| (self.distance(near, &hit), hit)));
                // Stable sort: equally near hits stay in the order of cell and index.
                tied.sort_by(|a, b| a.0.total_cmp(&b.0));
                hits.extend(tied.iter().map(|(_, hit)| *hit).take(limit - first));
            }
            if hits.len() == limit {
                break;
            }
        }
    }

    fn distance(&self, from: DVec3, hit: &Hit) -> f64 {
        from.distance(self.shards[hit.shard as usize].position_in_world(hit.index as usize))
    }
}

impl Order {
    /// Returns the score of the Gaussian at a rank, counted from 1 for the best; `None` if there are fewer.
    ///
    /// `scores`: by place, of `n_places`; `count`: the number of Gaussians with each. Sorts only the rank's bin,
    /// found by a histogram.
    fn score_at<I: Iterator<Item = (f32, usize)>>(
        &mut self,
        rank: usize,
        n_places: usize,
        scores: impl Fn(usize) -> I + Sync,
        count: impl Fn(usize, usize) -> u64 + Sync,
    ) -> Option<f32> {
        let n_parts = rayon::current_num_threads().min(n_places).max(1);
        self.parts.resize_with(n_parts, Part::default);
        let places = |part: usize| n_places * part / n_parts..n_places * (part + 1) / n_parts;
        self.parts.par_iter_mut().enumerate().for_each(|(part, Part { bins, .. })| {
            bins.clear();
            bins.resize(BINS, 0);
            for place in places(part) {
                scores(place).for_each(|(score, at)| bins[bin_of(score)] += count(place, at));
            }
        });
        let mut n_better = 0;
        let bin = (0..BINS).rev().find(|bin| {
            let n: u64 = self.parts.iter().map(|part| part.bins[*bin]).sum();
            let is_here = n_better + n >= rank as u64;
            n_better += if is_here { 0 } else { n };
            is_here
        })?;
        self.parts.par_iter_mut().enumerate().for_each(|(part, Part { in_bin, .. })| {
            in_bin.clear();
            for place in places(part) {
                let of_bin = scores(place).filter(|(score, _)| bin_of(*score) == bin);
                in_bin.extend(of_bin.map(|(score, at)| (score, count(place, at))));
            }
        });
        let (first, others) = self.parts.split_first_mut()?;
        others.iter().for_each(|part| first.in_bin.extend_from_slice(&part.in_bin));
        first.in_bin.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
        let reached = first.in_bin.iter().find(|(_, count)| {
            n_better += count;
            n_better >= rank as u64
        });
        reached.map(|(score, _)| *score)
    }
}

/// Returns a score that at least `limit` of the counted Gaussians reach; `None` if there are fewer.
fn score_reached(gather: &Gather, limit: usize) -> Option<f32> {
    let bins: Vec<&[u32]> = gather.shards.iter().map(|of_shard| &of_shard.bins[..]).collect();
    let mut n = 0;
    let bin = (0..BINS).rev().find(|bin| {
        n += bins.iter().filter_map(|bins| bins.get(*bin)).map(|n| u64::from(*n)).sum::<u64>();
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
