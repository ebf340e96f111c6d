//! The best-scoring Gaussians, without scoring them all.

use glam::DVec3;
use rayon::prelude::*;

use super::collect::{Cell, Gather, runs_inside};
use super::{Effort, Run, Search};

/// One Gaussian and its score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Position of the shard in the searched slice.
    pub shard: u32,
    /// Index in the shard.
    pub index: u32,
    /// Its own where the shard knows more of it than its row and that was asked for, else that of its row.
    pub score: f32,
}

/// Into how many parts the range of scores is cut to find a rank in it.
const BINS: usize = 4096;
/// Fewer keys than this are sorted on one thread.
const SORTED_ALONE: usize = 1 << 14;

/// Memory for ranking.
#[derive(Default)]
pub(super) struct Order {
    parts: Vec<Part>,
    runs: Vec<Run>,
    keys: Vec<u64>,
    tied: Vec<(f64, Hit)>,
}

/// What one thread counts.
#[derive(Default)]
struct Part {
    bins: Vec<u64>,
    in_bin: Vec<(f32, u64)>,
}

impl Search<'_> {
    /// Returns the `limit` best Gaussians that reach a threshold, best first: by score, then by distance
    /// from `near`, then by cell and index. The selection is exact with respect to the scores returned.
    pub fn best(&self, limit: usize, threshold: f32, near: Option<DVec3>) -> Vec<Hit> {
        let mut hits = Vec::new();
        self.best_into(limit, threshold, near, &mut hits);
        hits
    }

    /// As [`Search::best`], into a list that is cleared before. Returns what it took.
    pub fn best_into(
        &self,
        limit: usize,
        threshold: f32,
        near: Option<DVec3>,
        hits: &mut Vec<Hit>,
    ) -> Effort {
        hits.clear();
        if limit == 0 {
            return Effort::default();
        }
        let mut gather = self.take_gather();
        let mut effort = Effort::default();
        let has_detail = (0..self.shards.len()).any(|at| self.cell(at).is_some_and(|cell| cell.has_detail()));
        let cut = if has_detail {
            // Half as many again by their rows' scores: the worst of these members by their own scores are
            // not among the best.
            let enough = limit.saturating_add(limit / 2).saturating_add(1);
            let floor = self.row_score_at(&mut gather.order, enough, f32::NEG_INFINITY);
            self.collect(&mut gather, threshold, true, floor.unwrap_or(f32::NEG_INFINITY));
            effort += gather.effort();
            let Gather { shards, order } = &mut gather;
            let runs = |at: usize| &shards[at].found.runs;
            let count = |at: usize, run: usize| u64::from(runs(at)[run].end - runs(at)[run].start);
            order.score_at(limit, shards.len(), |at| runs(at).iter().map(|run| run.score).zip(0..), count)
        } else {
            self.row_score_at(&mut gather.order, limit, threshold)
        };
        self.collect(&mut gather, cut.unwrap_or(threshold), true, f32::NEG_INFINITY);
        effort += gather.effort();
        self.rank(&mut gather, limit, near, hits);
        self.put_back(gather);
        effort
    }

    /// Returns the least of the scores of the rows whose members, with those of better rows, are `limit`
    /// or more; none if there are fewer with a row that reaches the threshold.
    fn row_score_at(&self, order: &mut Order, limit: usize, threshold: f32) -> Option<f32> {
        let cells: Vec<Option<Cell<'_>>> = (0..self.shards.len()).map(|at| self.cell(at)).collect();
        let scores = |at: usize| {
            let rows = cells[at].as_ref().map_or(&[][..], |cell| cell.rows);
            rows.iter().copied().zip(0..).filter(move |(score, _)| *score >= threshold)
        };
        let count = |at: usize, row: usize| {
            let shard = &self.shards[at];
            let members = shard.row_starts[row] as usize..shard.row_starts[row + 1] as usize;
            match cells[at].as_ref().and_then(|cell| cell.filter) {
                None => members.len() as u64,
                filter => runs_inside(shard, filter, members).map(|inside| inside.len() as u64).sum(),
            }
        };
        order.score_at(limit, self.shards.len(), scores, count)
    }

    /// Sorts what was gathered.
    fn rank(&self, gather: &mut Gather, limit: usize, near: Option<DVec3>, hits: &mut Vec<Hit>) {
        let Gather { shards, order: Order { runs, keys, tied, .. } } = gather;
        let mut by_cell: Vec<usize> = (0..self.shards.len()).collect();
        by_cell.sort_by_key(|at| self.shards[*at].header.cell_id);
        runs.clear();
        by_cell.iter().for_each(|at| runs.extend_from_slice(&shards[*at].found.runs));
        keys.clear();
        // Places, in the order of cells and indices, decide between equal scores.
        keys.extend(runs.iter().zip(0u64..).map(|(run, place)| u64::from(!rising(run.score)) << 32 | place));
        match keys.len() < SORTED_ALONE {
            true => keys.sort_unstable(),
            false => keys.par_sort_unstable(),
        }
        hits.reserve(limit.min(runs.iter().map(|run| (run.end - run.start) as usize).sum()));
        for ties in keys.chunk_by(|a, b| a >> 32 == b >> 32) {
            let left = limit - hits.len();
            let of_ties = ties.iter().flat_map(|key| {
                let run = runs[*key as u32 as usize];
                (run.start..run.end).map(move |index| Hit { shard: run.shard, index, score: run.score })
            });
            match near {
                None => hits.extend(of_ties.take(left)),
                Some(near) => {
                    tied.clear();
                    tied.extend(of_ties.map(|hit| (self.distance(near, &hit), hit)));
                    // Stable: those as near stay in the order of their names.
                    tied.sort_by(|a, b| a.0.total_cmp(&b.0));
                    hits.extend(tied.iter().map(|(_, hit)| *hit).take(left));
                }
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
    /// Returns the score of the Gaussian at a rank, counted from 1 at the best; none if there are fewer.
    ///
    /// `scores`: scores at each of `n_places` and what `count` tells by how many Gaussians have them. Counts by
    /// parts of the range of scores find the part in question, and only that is sorted.
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

/// Returns the part of the range of scores that a score lies in; never falls as the score rises.
fn bin_of(score: f32) -> usize {
    // Few scores lie outside of -1..1, and those share the first and the last part.
    ((score + 1.0) * (BINS as f32 / 2.0)).clamp(0.0, (BINS - 1) as f32) as usize
}

/// Returns a number that rises with a score.
fn rising(score: f32) -> u32 {
    let bits = score.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}
