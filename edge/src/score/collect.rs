//! Gathers the Gaussians that reach a threshold: whole centroids where their bounds decide, else member by member.

use std::ops::Range;

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{BLOCK, Residuals, ShardView};

use super::cell::{Cell, Detail, Measured};
use super::dot::EmbeddingTimesVector;
use super::region::Region;
use super::search::{Matches, Run, Search, combine};
use super::simd::{BlockSums, FindSums, LastBlock, RowsTimesVector};

/// Number of bins; counting locates a rank's score before anything is sorted.
pub(super) const BINS: usize = 4096;

/// Returns the bin of a score; monotonic.
pub(super) fn bin_of(score: f32) -> usize {
    // Few scores lie outside -1..1; they share the first and the last bin.
    ((score + 1.0) * (BINS as f32 / 2.0)).clamp(0.0, (BINS - 1) as f32) as usize
}

/// Returns a lower bound on the scores of a bin.
pub(super) fn edge_of(bin: usize) -> f32 {
    // The first bin also holds all lower scores. Otherwise a little below the edge, because `bin_of` rounds.
    let edge = bin as f32 / (BINS as f32 / 2.0) - 1.0;
    if bin == 0 { f32::NEG_INFINITY } else { edge - 4.0 * f32::EPSILON }
}

#[derive(Clone, Copy)]
pub(super) struct Cut {
    pub score: f32,
    /// No score below this matches, even though `score` is an estimate.
    pub least: f32,
}

/// What was found in a shard, and buffers.
#[derive(Default)]
pub(super) struct Gather {
    pub found: Matches,
    /// Code sums of the block read last, by vector of the question.
    last: Vec<LastBlock>,
    /// Members of one centroid whose code sum reaches the minimum.
    sums: Vec<(u32, u16)>,
    refine: Refine,
    /// Whether matches are only counted, by their scores' bins.
    is_counting: bool,
    /// Number of scores in each bin; empty if there is none.
    pub bins: Vec<u32>,
}

/// Buffers for refining members of one centroid.
#[derive(Default)]
struct Refine {
    /// Members with code scores, later refined ones.
    members: Vec<(u32, f32)>,
    /// Undecided members: index in `members`, and the score of the code.
    undecided: Vec<(usize, f32)>,
    which: Vec<u32>,
    /// `[vectors][undecided]`.
    scores: Vec<f32>,
}

impl Search<'_> {
    /// Returns the Gaussians with scores at or above a threshold, as far as the shards' data decide.
    pub fn matching(&self, threshold: f32) -> Matches {
        let mut all = Matches::default();
        for Gather { found, .. } in self.collect(Cut { score: threshold, least: threshold }, false) {
            all.runs.extend_from_slice(&found.runs);
            all.n_gaussians += found.n_gaussians;
            all.effort += found.effort;
        }
        all
    }

    /// Gathers the Gaussians that reach a threshold. `each`: scores members individually wherever the shard can.
    pub(super) fn collect(&self, cut: Cut, each: bool) -> Vec<Gather> {
        self.gather(|cell, gather| cell.collect(gather, cut, each, f32::NEG_INFINITY))
    }

    /// Counts the Gaussians that reach a threshold by their own scores, in centroids that score at least `floor`.
    pub(super) fn count(&self, threshold: f32, floor: f32) -> Vec<Gather> {
        self.gather(|cell, gather| {
            gather.is_counting = true;
            cell.collect(gather, Cut { score: threshold, least: threshold }, true, floor);
        })
    }

    /// Works through the cells in parallel; returns what was found, by shard.
    fn gather(&self, work: impl Fn(&Cell<'_>, &mut Gather) + Sync) -> Vec<Gather> {
        let of_shard = |at: usize| {
            let mut gather = Gather::default();
            if let Some(cell) = self.cell(at).filter(|_| self.budget.goes_on()) {
                work(&cell, &mut gather);
                self.budget.take(size_of_val(&gather.found.runs[..]));
            }
            gather
        };
        (0..self.shards.len()).into_par_iter().map(of_shard).collect()
    }
}

impl Cell<'_> {
    fn collect(&self, gather: &mut Gather, cut: Cut, each: bool, floor: f32) {
        gather.last.resize_with(self.asked.places.len(), LastBlock::default);
        let margin = match self.detail {
            Detail::Measured(Measured { code_margin, .. }) if !gather.is_counting => code_margin,
            _ => 0.0,
        };
        for centroid in 0..self.centroids.len() {
            if self.centroids[centroid] < floor {
                continue;
            }
            let (lower, upper) = self.bounds(centroid);
            if upper + margin < cut.score {
                continue;
            }
            let is_scanned = lower - margin < cut.score || each;
            let members = self.shard.centroid_starts[centroid] as usize
                ..self.shard.centroid_starts[centroid + 1] as usize;
            for inside in runs_inside(self.shard, self.filter.as_ref(), members) {
                match self.detail {
                    Detail::Residuals(residuals) if is_scanned => {
                        self.scan(gather, &residuals, centroid, inside, cut.score);
                        self.push_scanned(gather);
                    }
                    Detail::Measured(measured) if is_scanned => {
                        self.scan(gather, &measured.residuals, centroid, inside, cut.score - margin);
                        if margin > 0.0 {
                            self.refine(gather, &measured, centroid, cut);
                        }
                        self.push_scanned(gather);
                    }
                    Detail::Embeddings(embeddings) if is_scanned => {
                        self.rescore(gather, embeddings, inside, cut.score);
                    }
                    _ => self.push(gather, inside, self.centroids[centroid]),
                }
            }
        }
    }

    fn push(&self, gather: &mut Gather, members: Range<usize>, score: f32) {
        if gather.is_counting {
            gather.bins.resize(BINS, 0);
            gather.bins[bin_of(score)] += members.len() as u32;
            return;
        }
        gather.found.n_gaussians += members.len() as u64;
        let (start, end) = (members.start as u32, members.end as u32);
        gather.found.runs.push(Run { shard: self.at, start, end, score });
    }

    fn rescore(&self, gather: &mut Gather, embeddings: &[f16], members: Range<usize>, threshold: f32) {
        gather.found.effort.n_rescored += members.len() as u64;
        gather.found.effort.n_embeddings_read += members.len() as u64;
        for at in members {
            let score = self.exact_score(embeddings, at);
            if score >= threshold {
                self.push(gather, at..at + 1, score);
            }
        }
    }

    fn exact_score(&self, embeddings: &[f16], at: usize) -> f32 {
        let dim = self.shard.header.dim as usize;
        let embedding = &embeddings[at * dim..][..dim];
        let product = |vector| self.instructions.dispatch(EmbeddingTimesVector(embedding, vector));
        let mut products = self.asked.question.vectors().map(product);
        combine(products.next().unwrap_or(0.0), products, self.asked.question.least)
    }

    /// Scores members of a centroid by their codes; those that reach the threshold go to `gather.refine`.
    fn scan(
        &self,
        gather: &mut Gather,
        residuals: &Residuals<'_>,
        centroid: usize,
        members: Range<usize>,
        threshold: f32,
    ) {
        gather.found.effort.n_rescored += members.len() as u64;
        gather.refine.members.clear();
        let Gather { last, sums, refine, .. } = gather;
        let [first, others @ ..] = &mut last[..] else { return };
        let places = &self.asked.places;
        let tables = &self.scores.projections[places[0]].tables;
        let (own, step) = self.line(places[0], centroid, residuals);
        // The score grows with the sum: sums are compared, and only matches are scored.
        let is_single = places.len() == 1;
        let least = if is_single { least_sum(own, step, tables.most, threshold) } else { Some(0) };
        let Some(least) = least else { return };
        sums.clear();
        self.instructions.dispatch(FindSums {
            columns: residuals.codes.as_chunks::<BLOCK>().0,
            low: &tables.low,
            high: &tables.high,
            members,
            least,
            last: first,
            found: sums,
        });
        if is_single {
            let score = |(at, sum): &(u32, u16)| (*at, own + step * f32::from(*sum) + 0.0);
            refine.members.extend(sums.iter().map(score));
            return;
        }
        for (at, sum) in sums.iter() {
            let (block, within) = (*at as usize / BLOCK, *at as usize % BLOCK);
            let negatives = others.iter_mut().zip(&places[1..]).map(|(last, place)| {
                if last.block != Some(block) {
                    *last = self.sum_block(residuals, *place, block);
                }
                let (least, step) = self.line(*place, centroid, residuals);
                least + step * f32::from(last.sums[within])
            });
            let score = combine(own + step * f32::from(*sum), negatives, self.asked.question.least);
            if score >= threshold {
                refine.members.push((*at, score));
            }
        }
    }

    fn sum_block(&self, residuals: &Residuals<'_>, place: usize, block: usize) -> LastBlock {
        let tables = &self.scores.projections[place].tables;
        let columns = &residuals.codes.as_chunks::<BLOCK>().0[block * tables.low.len()..][..tables.low.len()];
        let work = BlockSums { columns, low: &tables.low, high: &tables.high };
        LastBlock { block: Some(block), sums: self.instructions.dispatch(work) }
    }

    fn push_scanned(&self, gather: &mut Gather) {
        let Gather { refine, found, bins, is_counting, .. } = gather;
        if *is_counting {
            bins.resize(BINS, 0);
            refine.members.iter().for_each(|(_, score)| bins[bin_of(*score)] += 1);
            return;
        }
        found.n_gaussians += refine.members.len() as u64;
        let run = |(at, score): &(u32, f32)| Run { shard: self.at, start: *at, end: at + 1, score: *score };
        found.runs.extend(refine.members.iter().map(run));
    }

    /// Refines the scores of undecided members by fine residuals and embeddings, and drops non-matches.
    fn refine(&self, gather: &mut Gather, measured: &Measured<'_>, centroid: usize, cut: Cut) {
        let Gather { refine, found, .. } = gather;
        let Refine { members, undecided, which, scores } = refine;
        undecided.clear();
        which.clear();
        for (place, (at, score)) in members.iter().enumerate() {
            if *score < cut.score + measured.code_margin {
                undecided.push((place, *score));
                which.push(*at);
            }
        }
        if let Some(fine) = &measured.exact.fine {
            found.effort.n_fine_read += which.len() as u64;
            scores.clear();
            for place in &self.asked.places {
                let rounded = &self.scores.projections[*place].fine;
                let products = self.instructions.dispatch(RowsTimesVector {
                    rows: fine.values,
                    n_components: self.shard.header.n_components as usize,
                    vector: &rounded.steps,
                    which,
                });
                let (own, step) = (
                    self.scores.centroids[*place][centroid],
                    f64::from(fine.scales[centroid]) * rounded.step,
                );
                scores.extend(products.into_iter().map(|product| own + (step * f64::from(product)) as f32));
            }
            for (number, (place, _)) in undecided.iter().enumerate() {
                let mut products = scores[number..].iter().step_by(which.len()).copied();
                let score = combine(products.next().unwrap_or(0.0), products, self.asked.question.least);
                // The embedding's score lies within this bound, whatever the residual says.
                let (of_centroid, bound) = (self.centroids[centroid], self.embedding_bound(centroid));
                members[*place].1 = score.max(of_centroid - bound).min(of_centroid + bound);
            }
        }
        for (place, of_code) in undecided.iter() {
            let (at, score) = &mut members[*place];
            if measured.exact.fine.is_none() || (*score - cut.score).abs() <= measured.fine_margin {
                found.effort.n_embeddings_read += 1;
                *score = self.exact_score(measured.exact.embeddings, *at as usize);
            }
            // Accepted members stay unless below the minimum, so that the number found equals the number asked for.
            let is_out = *of_code < cut.score && *score < cut.score - measured.fine_margin;
            if is_out || *score < cut.least {
                *score = f32::NEG_INFINITY;
            }
        }
        members.retain(|(_, score)| *score > f32::NEG_INFINITY);
    }
}

/// Returns the least sum up to `most` with `own + step * sum` at or above a threshold, if any.
fn least_sum(own: f32, step: f32, most: u16, threshold: f32) -> Option<u16> {
    let reaches = |sum: u16| own + step * f32::from(sum) >= threshold;
    if !reaches(most) {
        return None;
    }
    // Off by rounding only, except that a flat line may put it far away.
    let guess = (((threshold - own) / step).ceil() as u16).min(most);
    let near = guess.saturating_sub(2)..guess.saturating_add(2).min(most);
    let (mut low, mut high) = (0, most);
    if near.start == 0 || !reaches(near.start - 1) {
        low = near.start;
    }
    if reaches(near.end) {
        high = near.end;
    }
    while low < high {
        let middle = low + (high - low) / 2;
        if reaches(middle) { high = middle } else { low = middle + 1 }
    }
    Some(low)
}

pub(super) fn runs_inside(
    shard: &ShardView<'_>,
    filter: Option<&Region>,
    members: Range<usize>,
) -> impl Iterator<Item = Range<usize>> {
    let mut at = members.start;
    std::iter::from_fn(move || {
        let Some(region) = filter else {
            let rest = at..members.end;
            at = members.end;
            return (!rest.is_empty()).then_some(rest);
        };
        let inside = |index: &usize| region.contains(shard.position_in_world(*index));
        let start = (at..members.end).find(inside)?;
        at = (start..members.end).find(|index| !inside(index)).unwrap_or(members.end);
        Some(start..at)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Oracle: every sum, tried in turn. Steps range from far below the score's last bit to far above it.
    #[test]
    fn the_least_sum_is_the_first_that_reaches() {
        let mut random = Random::new(41);
        for _ in 0..3000 {
            let own = random.signed();
            let step = [0.0, 1e-10, 1e-9, 1e-7, 1e-4, 0.1][random.bits() as usize % 6];
            let most = (random.bits() % 3000) as u16;
            let at = (random.bits() % 3000) as f32;
            for threshold in [own, own.next_up(), own.next_down(), own + step * at, f32::NEG_INFINITY, 9e9] {
                let expected = (0..=most).find(|sum| own + step * f32::from(*sum) >= threshold);
                let found = least_sum(own, step, most, threshold);
                assert_eq!(found, expected, "{own} {step} {most} {threshold}");
            }
        }
    }
}
