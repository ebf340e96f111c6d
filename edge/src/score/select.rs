//! The best-scoring Gaussians, without scoring them all.

use glam::DVec3;
use rayon::prelude::*;

use super::cell::Cell;
use super::centroids::AskedQuestion;
use super::collect::{BINS, Cut, Gather, bin_of, edge_of, runs_inside};
use super::matches::{Effort, Hit, Run};

/// Bits per pass of the radix sort: its counters stay in the L1 cache.
const DIGIT_BITS: u32 = 11;
/// With fewer runs, a second thread does not pay off.
const MIN_RUNS_PER_THREAD: usize = if cfg!(test) { 16 } else { 8192 };

/// Buffers that answers are gathered and ranked in, kept from one answer to the next.
#[derive(Default)]
pub(super) struct AnswerBuffers {
    pub gather: Gather,
    order: Order,
}

/// Buffers for ranking.
#[derive(Default)]
struct Order {
    parts: Vec<Part>,
    runs: Vec<Run>,
    keys: Vec<u64>,
    ranked: Vec<Ranked>,
}

/// Input and output of one ranking thread.
#[derive(Default)]
struct Ranked {
    keys: Vec<u64>,
    swapped: Vec<u64>,
    tied: Vec<(f64, Hit)>,
    hits: Vec<Hit>,
}

/// Counters of one counting thread.
#[derive(Default)]
struct Part {
    bins: Vec<u64>,
    in_bin: Vec<(f32, u64)>,
}

impl AskedQuestion<'_> {
    /// Ranks the `limit` best Gaussians that reach a threshold into `hits`, which is cleared first; see
    /// [`super::Search::best`].
    pub(super) fn best_into(
        &self,
        buffers: &mut AnswerBuffers,
        limit: usize,
        threshold: f32,
        near: Option<DVec3>,
        hits: &mut Vec<Hit>,
    ) -> Effort {
        hits.clear();
        if limit == 0 {
            return Effort::default();
        }
        let AnswerBuffers { gather, order } = buffers;
        let mut effort = Effort::default();
        let has_detail = (0..self.shards.len()).any(|at| self.cell(at).is_some_and(|cell| cell.has_detail()));
        let cut = if has_detail {
            // Ranks half as many again by centroid scores: members that rank last by their own scores are
            // then not among the best.
            let enough = limit.saturating_add(limit / 2).saturating_add(1);
            let floor = self.centroid_score_at(order, enough, f32::NEG_INFINITY);
            self.count(gather, threshold, floor.unwrap_or(f32::NEG_INFINITY));
            effort += gather.effort();
            score_reached(gather, limit).map(|score| score.max(threshold))
        } else {
            self.centroid_score_at(order, limit, threshold)
        };
        self.collect(gather, Cut { score: cut.unwrap_or(threshold), least: threshold }, true);
        effort += gather.effort();
        self.rank(gather, order, limit, near, hits);
        effort
    }

    /// Returns the lowest centroid score that must be included for the members of centroids at or above it to
    /// number `limit` or more; `None` if too few centroids reach the threshold.
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

    /// Sorts the gathered runs.
    fn rank(
        &self,
        gather: &Gather,
        order: &mut Order,
        limit: usize,
        near: Option<DVec3>,
        hits: &mut Vec<Hit>,
    ) {
        let Order { runs, keys, ranked, .. } = order;
        let mut by_cell: Vec<usize> = (0..self.shards.len()).collect();
        by_cell.sort_by_key(|at| self.shards[*at].header.cell_id);
        runs.clear();
        by_cell.iter().for_each(|at| runs.extend_from_slice(&gather.shards[*at].found.runs));
        keys.clear();
        // Equal scores keep the order of the runs, which is that of cells and indices.
        keys.extend(runs.iter().zip(0u64..).map(|(run, place)| u64::from(!rising(run.score)) << 32 | place));
        let n_parts = rayon::current_num_threads().min(keys.len() / MIN_RUNS_PER_THREAD).max(1);
        ranked.resize_with(n_parts, Ranked::default);
        share_by_high_half(keys, ranked);
        ranked.par_iter_mut().for_each(|part| self.rank_part(part, runs, limit, near));
        for part in ranked {
            let n = part.hits.len().min(limit - hits.len());
            hits.extend_from_slice(&part.hits[..n]);
        }
    }

    /// Turns sorted keys into hits, at most `limit`.
    fn rank_part(&self, part: &mut Ranked, runs: &[Run], limit: usize, near: Option<DVec3>) {
        let Ranked { keys, swapped, tied, hits } = part;
        sort_by_high_half(keys, swapped);
        hits.clear();
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
    /// `scores` gives the scores at each of `n_places`; `count` gives the number of Gaussians with each. A
    /// histogram locates the bin of the rank, and only that bin is sorted.
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

/// Distributes keys over parts of similar size. Keys with a lower upper half go to an earlier part; within a
/// part the order is kept.
fn share_by_high_half(keys: &mut Vec<u64>, parts: &mut [Ranked]) {
    parts.iter_mut().for_each(|part| part.keys.clear());
    if let [all] = parts {
        std::mem::swap(keys, &mut all.keys);
        return;
    }
    let all_high = || keys.iter().map(|key| (key >> 32) as u32);
    let (least, most) = (all_high().min().unwrap_or(0), all_high().max().unwrap_or(0));
    let shift = (u32::BITS - (most - least).leading_zeros()).saturating_sub(DIGIT_BITS);
    let digit = |key: u64| (((key >> 32) as u32 - least) >> shift) as usize;
    let mut part_of = [0usize; 1 << DIGIT_BITS];
    keys.iter().for_each(|key| part_of[digit(*key)] += 1);
    let mut n_before = 0;
    for count in &mut part_of {
        let part = n_before * parts.len() / keys.len();
        n_before += std::mem::replace(count, part);
    }
    keys.iter().for_each(|key| parts[part_of[digit(*key)]].keys.push(*key));
}

/// Sorts by the upper 32 bits, stably. `swapped` is a buffer.
fn sort_by_high_half(keys: &mut Vec<u64>, swapped: &mut Vec<u64>) {
    let all_high = || keys.iter().map(|key| (key >> 32) as u32);
    let (least, most) = (all_high().min().unwrap_or(0), all_high().max().unwrap_or(0));
    let n_bits = u32::BITS - (most - least).leading_zeros();
    swapped.clear();
    swapped.resize(keys.len(), 0);
    for shift in (0..n_bits).step_by(DIGIT_BITS as usize) {
        let digit = |key: u64| (((key >> 32) as u32 - least) >> shift) as usize & ((1 << DIGIT_BITS) - 1);
        let mut places = [0usize; 1 << DIGIT_BITS];
        keys.iter().for_each(|key| places[digit(*key)] += 1);
        let mut n_before = 0;
        for place in &mut places {
            n_before += std::mem::replace(place, n_before);
        }
        for key in &*keys {
            let place = &mut places[digit(*key)];
            swapped[*place] = *key;
            *place += 1;
        }
        std::mem::swap(keys, swapped);
    }
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

    /// Oracle: the standard library's stable sort.
    #[test]
    fn keys_are_sorted_by_score_and_place() {
        let mut random = Random::new(31);
        let mut swapped = Vec::new();
        for n in [0, 1, 2, 3000] {
            for n_bits in [0, 1, 11, 12, 23, 32] {
                let mut key = |place: u64| {
                    let high = if n_bits == 0 { 7 } else { random.bits() >> (64 - n_bits) };
                    high << 32 | place
                };
                let mut keys: Vec<u64> = (0..n).map(&mut key).collect();
                let mut expected = keys.clone();
                expected.sort();
                sort_by_high_half(&mut keys, &mut swapped);
                assert_eq!(keys, expected, "{n} {n_bits}");
            }
        }
    }

    /// Oracle: the standard library's stable sort of all parts in turn.
    #[test]
    fn keys_are_shared_in_order() {
        let mut random = Random::new(33);
        for n in [1, 2, 3000] {
            for n_bits in [1, 5, 11, 12, 32] {
                for n_parts in [1, 2, 3, 7] {
                    let mut keys: Vec<u64> =
                        (0..n).map(|place| random.bits() >> (64 - n_bits) << 32 | place).collect();
                    let mut expected = keys.clone();
                    expected.sort();
                    let mut parts = Vec::new();
                    parts.resize_with(n_parts, Ranked::default);
                    share_by_high_half(&mut keys, &mut parts);
                    let mut found = Vec::new();
                    for part in &mut parts {
                        sort_by_high_half(&mut part.keys, &mut part.swapped);
                        found.extend_from_slice(&part.keys);
                    }
                    assert_eq!(found, expected, "{n} {n_bits} {n_parts}");
                }
            }
        }
    }

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
