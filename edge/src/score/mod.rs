//! Scores questions against shards, palette row by palette row.
//!
//! A row's radius `r` bounds `||E_k - P[row]||` over its members, so a score of a member is within
//! `r * steepness` of the row's, where the steepness is 1 for a plain cosine and `max_j ||q - n_j||` with
//! negatives. Where a shard carries exact embeddings (and they are asked for), rows that stay at or above
//! the threshold by more than that are in as a whole, rows below it by more are out, and only members of
//! the rows between are scored one by one. Where it does not, a row is in when its own score reaches the
//! threshold, and the answer carries the bound.

mod dot;
mod question;
mod region;
mod select;

use std::ops::Range;

use rayon::prelude::*;
use slag_common::shard::ShardView;

pub use dot::{dot, rounding_bound};
pub use question::{Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};
pub use region::{Ball, Region};
pub use select::Hit;

/// Positions beyond this many world units are no scene (a hundred times the earth's diameter) and
/// would overflow what is computed from them.
pub const MAX_COORDINATE: f64 = 1e9;
/// How far a unit embedding stored as f16 may lie from the one its row's radius was measured to: half a
/// step of f16 at 1 (2^-11), and the steps of components too small for f16's exponents.
const F16_ROUNDING: f32 = 5e-4;

/// Why shards cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    /// The query vector is of another space.
    #[error(
        "cell {cell_id} holds embeddings of {expected} components, the query vector has {found}; use the models that the scene was encoded with"
    )]
    Dimension {
        /// The cell.
        cell_id: u32,
        /// Components of the shard.
        expected: usize,
        /// Components of the query.
        found: usize,
    },
    /// The query vector is not of unit length, or not finite.
    #[error("the query vector has length {found}, expected 1; the text model is damaged or of another kind")]
    NotUnit {
        /// Its length.
        found: f32,
    },
    /// A negative is of another space than the question.
    #[error(
        "a negative has {found} components, the query vector {expected}; take both from the same text model"
    )]
    Negative {
        /// Components of the query.
        expected: usize,
        /// Components of the negative.
        found: usize,
    },
    /// A shard's positions lie where no scene is.
    #[error(
        "cell {cell_id}: positions reach {found:e}, the limit is {MAX_COORDINATE:e} world units; encode the scene again around a nearer origin"
    )]
    Extent {
        /// The cell.
        cell_id: u32,
        /// Largest coordinate.
        found: f64,
    },
}

/// Which data scores come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Palette rows alone: fastest, every score within the bound stated.
    Rows,
    /// Rows, and exact embeddings for what rows cannot decide, of shards that carry them.
    #[default]
    Exact,
}

/// Matching Gaussians of one shard that lie next to each other and share a score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Run {
    /// Position of the shard in the searched slice.
    pub shard: u32,
    /// First member.
    pub start: u32,
    /// One past the last member.
    pub end: u32,
    /// Score of the row, or of the one Gaussian where it was scored by itself.
    pub score: f32,
}

/// Gaussians that reach a threshold.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Runs, by shard and start, ascending; they do not overlap.
    pub runs: Vec<Run>,
    /// Gaussians in the runs.
    pub n_gaussians: u64,
    /// Rows that could only be decided member by member.
    pub n_rows_undecided: u64,
    /// Gaussians that were scored by themselves.
    pub n_rescored: u64,
    /// Shards none of whose rows can reach the threshold.
    pub n_shards_below: usize,
}

/// One question's row scores over some shards; gives several kinds of answers without scoring twice.
pub struct Search<'a> {
    shards: &'a [ShardView<'a>],
    question: &'a Question,
    region: Region,
    precision: Precision,
    /// Per shard, the score of each row; `None` where the shard lies outside the region.
    row_scores: Vec<Option<Vec<f32>>>,
}

impl<'a> Search<'a> {
    /// Scores the rows of the shards that reach into the region. As [`Search::batch`], for one question.
    ///
    /// # Errors
    /// [`ScoreError`].
    pub fn new(
        shards: &'a [ShardView<'a>],
        question: &'a Question,
        region: Region,
        precision: Precision,
    ) -> Result<Self, ScoreError> {
        check(shards, question)?;
        let scored = score_rows(shards, std::slice::from_ref(question), region);
        let row_scores = scored.into_iter().map(|of_shard| of_shard?.pop()).collect();
        Ok(Self { shards, question, region, precision, row_scores })
    }

    /// Scores the rows for several questions in one pass; returns a search for each, in their order.
    ///
    /// Costs one product per row, component and distinct vector (negatives that questions share are
    /// multiplied once), in parallel by shard.
    /// # Errors
    /// [`ScoreError`].
    pub fn batch(
        shards: &'a [ShardView<'a>],
        questions: &'a [Question],
        region: Region,
        precision: Precision,
    ) -> Result<Vec<Self>, ScoreError> {
        questions.iter().try_for_each(|question| check(shards, question))?;
        let mut searches: Vec<Self> = questions
            .iter()
            .map(|question| Self { shards, question, region, precision, row_scores: Vec::new() })
            .collect();
        for of_shard in score_rows(shards, questions, region) {
            let mut of_questions = of_shard.into_iter().flatten();
            searches.iter_mut().for_each(|search| search.row_scores.push(of_questions.next()));
        }
        Ok(searches)
    }

    /// Returns the Gaussians whose score reaches a threshold, as far as the shards' data tell.
    pub fn matching(&self, threshold: f32) -> Matches {
        self.collect(threshold, false)
    }

    /// Gathers what reaches a threshold over all shards. `each`: members of shards with exact embeddings
    /// get scores of their own even where their row alone decides.
    fn collect(&self, threshold: f32, each: bool) -> Matches {
        let shards = (0..self.shards.len()).into_par_iter();
        let per_shard: Vec<Matches> = shards.map(|shard| self.collect_in(shard, threshold, each)).collect();
        let mut all = Matches::default();
        for mut found in per_shard {
            all.runs.append(&mut found.runs);
            all.n_gaussians += found.n_gaussians;
            all.n_rows_undecided += found.n_rows_undecided;
            all.n_rescored += found.n_rescored;
            all.n_shards_below += found.n_shards_below;
        }
        all
    }

    fn collect_in(&self, shard_at: usize, threshold: f32, each: bool) -> Matches {
        let mut found = Matches::default();
        let Some(scores) = &self.row_scores[shard_at] else { return found };
        let shard = &self.shards[shard_at];
        let exact = shard.exact.filter(|_| self.precision == Precision::Exact);
        let (filter, slack) = (self.filter(shard), self.slack(shard));
        let mut reachable = false;
        for (row, score) in scores.iter().copied().enumerate() {
            let slack = slack(row);
            if score + slack < threshold {
                continue;
            }
            reachable = true;
            let is_undecided = score - slack < threshold;
            for inside in runs_inside(shard, filter, shard.members(row)) {
                let run = |range: Range<usize>, score: f32| {
                    let (start, end) = (range.start as u32, range.end as u32);
                    Run { shard: shard_at as u32, start, end, score }
                };
                match exact {
                    Some(exact) if is_undecided || each => {
                        found.n_rescored += inside.len() as u64;
                        let scored = inside.map(|at| (at, self.exact_score(exact.embeddings, at)));
                        let reaching = scored.filter(|(_, score)| *score >= threshold);
                        let before = found.runs.len();
                        found.runs.extend(reaching.map(|(at, score)| run(at..at + 1, score)));
                        found.n_gaussians += (found.runs.len() - before) as u64;
                    }
                    _ => {
                        found.n_gaussians += inside.len() as u64;
                        found.runs.push(run(inside, score));
                    }
                }
            }
            found.n_rows_undecided += u64::from(exact.is_some() && is_undecided);
        }
        found.n_shards_below = usize::from(!reachable);
        found
    }

    /// Returns by how much a member's score may differ from its row's, by row; 0 where the row's counts
    /// for all its members.
    fn slack<'b>(&self, shard: &'b ShardView<'_>) -> impl Fn(usize) -> f32 + use<'b> {
        let (steepness, rounding) = (self.question.steepness(), self.question.rounding_bound());
        let is_exact = shard.exact.is_some() && self.precision == Precision::Exact;
        // Both the row's score and the member's own are rounded.
        let slack = move |row: usize| steepness * (shard.radii[row] + F16_ROUNDING) + 2.0 * rounding;
        move |row| if is_exact { slack(row) } else { 0.0 }
    }

    fn exact_score(&self, embeddings: &[half::f16], index: usize) -> f32 {
        let dim = self.question.vector.len();
        let embedding = &embeddings[index * dim..][..dim];
        combine(self.question.vectors().map(|vector| dot(embedding, vector)))
    }

    /// Returns the region where the shard sticks out of it.
    fn filter(&self, shard: &ShardView<'_>) -> Option<Region> {
        (!self.region.covers(&shard.position_box())).then_some(self.region)
    }

    /// Returns all shards, which runs and hits refer to by place.
    pub fn shards(&self) -> &'a [ShardView<'a>] {
        self.shards
    }

    /// Returns the shards that were searched (the others lie outside the region).
    pub fn searched(&self) -> impl Iterator<Item = &'a ShardView<'a>> {
        self.shards
            .iter()
            .zip(&self.row_scores)
            .filter(|(_, scores)| scores.is_some())
            .map(|(shard, _)| shard)
    }

    /// Returns the bound on the error of scores: for every Gaussian searched, its row's score is off by at
    /// most this.
    pub fn score_error_bound(&self) -> f32 {
        let largest = self.searched().flat_map(|shard| shard.radii).fold(0.0, |a: f32, b| a.max(*b));
        self.question.steepness() * largest + self.question.rounding_bound()
    }

    /// Whether membership is exact: exact embeddings were asked for and every shard searched carries them.
    pub fn is_exact(&self) -> bool {
        self.precision == Precision::Exact && self.searched().all(|shard| shard.exact.is_some())
    }
}

fn check(shards: &[ShardView<'_>], question: &Question) -> Result<(), ScoreError> {
    question.check()?;
    for shard in shards {
        let header = &shard.header;
        let (expected, found) = (header.dim as usize, question.vector.len());
        if expected != found {
            return Err(ScoreError::Dimension { cell_id: header.cell_id, expected, found });
        }
        let reach = shard.position_box();
        let found = reach.min.abs().max(reach.max.abs()).max_element();
        if found.is_nan() || found > MAX_COORDINATE {
            return Err(ScoreError::Extent { cell_id: header.cell_id, found });
        }
    }
    Ok(())
}

/// Returns the score made of the product with the question's vector and, after it, those with negatives;
/// never -0, which would sort after 0 though it is equal.
fn combine(mut products: impl Iterator<Item = f32>) -> f32 {
    let own = products.next().unwrap_or(0.0);
    products.reduce(f32::max).map_or(own, |worst| own - worst) + 0.0
}

/// Returns, per shard that reaches into the region, the scores `[questions][rows]`.
fn score_rows(
    shards: &[ShardView<'_>],
    questions: &[Question],
    region: Region,
) -> Vec<Option<Vec<Vec<f32>>>> {
    let mut vectors: Vec<&[f32]> = Vec::new();
    let mut place = |vector| {
        vectors.iter().position(|known| *known == vector).unwrap_or_else(|| {
            vectors.push(vector);
            vectors.len() - 1
        })
    };
    let places: Vec<Vec<usize>> =
        questions.iter().map(|question| question.vectors().map(&mut place).collect()).collect();
    let score_shard = |shard: &ShardView<'_>| {
        let n_rows = shard.header.n_rows as usize;
        let mut scores: Vec<Vec<f32>> = questions.iter().map(|_| Vec::with_capacity(n_rows)).collect();
        let mut products = vec![0.0; vectors.len()];
        let mut row = vec![0.0; shard.header.dim as usize];
        for at in 0..n_rows {
            shard.decode_row(at, &mut row);
            products.iter_mut().zip(&vectors).for_each(|(product, vector)| {
                *product = row.iter().zip(*vector).map(|(a, b)| a * f64::from(*b)).sum::<f64>() as f32
            });
            for (scores, places) in scores.iter_mut().zip(&places) {
                scores.push(combine(places.iter().map(|place| products[*place])));
            }
        }
        scores
    };
    let in_region = |shard: &ShardView<'_>| region.touches(&shard.position_box()).then(|| score_shard(shard));
    shards.par_iter().map(in_region).collect()
}

/// Returns the parts of a range of Gaussians that lie inside the filter.
fn runs_inside(
    shard: &ShardView<'_>,
    filter: Option<Region>,
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
mod tests;
