//! Scores a query vector against shards, palette row by palette row.
//!
//! A row's radius `r` bounds `||E_k - P[row]||` over its members, so a unit query's score of a member
//! is within `r` of the row's score. Where a shard carries exact embeddings, rows that stay at or
//! above the threshold by more than `r` are in as a whole, rows below it by more than `r` are out, and
//! only members of the rows between are scored one by one. Where it does not, a row is in when its own
//! score reaches the threshold, and the answer carries the bound.

mod best;
mod dot;

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;
use slag_common::frames::Aabb;
use slag_common::shard::ShardView;

pub use best::Hit;
pub use dot::{dot, rounding_bound};

/// Positions beyond this many world units are no scene (a hundred times the earth's diameter) and
/// would overflow what is computed from them.
pub const MAX_COORDINATE: f64 = 1e9;
/// Half a step of f16 at 1: how far a stored unit embedding may lie from the one its row's radius
/// was measured to.
const F16_ROUNDING: f32 = 1.0 / 2048.0;

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

/// The part of space that a query asks for: Gaussians whose mean lies within.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Its centre.
    pub centre_in_world: DVec3,
    /// Its radius, world units.
    pub radius: f64,
}

impl Ball {
    fn contains(&self, point: DVec3) -> bool {
        point.distance_squared(self.centre_in_world) <= self.radius * self.radius
    }

    /// Whether every point of a box is inside.
    fn covers(&self, bounds: &Aabb) -> bool {
        let farthest =
            (bounds.min - self.centre_in_world).abs().max((bounds.max - self.centre_in_world).abs());
        farthest.length() <= self.radius
    }
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

/// One query's row scores over some shards; answers several questions without scoring twice.
pub struct Search<'a> {
    shards: &'a [ShardView<'a>],
    query: &'a [f32],
    ball: Option<Ball>,
    /// Per shard, the score of each row; `None` where the shard's box is outside the ball.
    row_scores: Vec<Option<Vec<f32>>>,
}

impl<'a> Search<'a> {
    /// Scores the rows of the shards that come within the ball.
    ///
    /// `query`: `[dim]`, unit length. Costs one product per row and component, in parallel by shard.
    /// # Errors
    /// [`ScoreError`].
    pub fn new(
        shards: &'a [ShardView<'a>],
        query: &'a [f32],
        ball: Option<Ball>,
    ) -> Result<Self, ScoreError> {
        let length = query.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt() as f32;
        // Text models normalise in f32, or from f16 tables.
        if !(0.999..=1.001).contains(&length) {
            return Err(ScoreError::NotUnit { found: length });
        }
        for shard in shards {
            let header = &shard.header;
            if header.dim as usize != query.len() {
                let (expected, found) = (header.dim as usize, query.len());
                return Err(ScoreError::Dimension { cell_id: header.cell_id, expected, found });
            }
            let reach = position_box(shard);
            let found = reach.min.abs().max(reach.max.abs()).max_element();
            if !(0.0..=MAX_COORDINATE).contains(&found) {
                return Err(ScoreError::Extent { cell_id: header.cell_id, found });
            }
        }
        let row_scores = shards
            .par_iter()
            .map(|shard| {
                let within =
                    |ball: Ball| position_box(shard).distance_to(ball.centre_in_world) <= ball.radius;
                ball.is_none_or(within)
                    .then(|| shard.palette.chunks_exact(query.len()).map(|row| dot(row, query)).collect())
            })
            .collect();
        Ok(Self { shards, query, ball, row_scores })
    }

    /// Returns the Gaussians whose score reaches a threshold, as far as the shards' data tell.
    pub fn matching(&self, threshold: f32) -> Matches {
        let per_shard: Vec<Matches> =
            (0..self.shards.len()).into_par_iter().map(|shard| self.matching_in(shard, threshold)).collect();
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

    fn matching_in(&self, shard_at: usize, threshold: f32) -> Matches {
        let mut found = Matches::default();
        let Some(scores) = &self.row_scores[shard_at] else { return found };
        let shard = &self.shards[shard_at];
        let rounding = rounding_bound(self.query.len());
        let filter = self.filter(shard);
        let mut reachable = false;
        for (row, score) in scores.iter().copied().enumerate() {
            let slack = shard.radii[row] + rounding + F16_ROUNDING;
            reachable |= score + slack >= threshold;
            let whole = |found: &mut Matches| {
                for run in runs_inside(shard, filter, shard.members(row)) {
                    found.n_gaussians += run.len() as u64;
                    let (start, end) = (run.start as u32, run.end as u32);
                    found.runs.push(Run { shard: shard_at as u32, start, end, score });
                }
            };
            match &shard.exact {
                None if score >= threshold => whole(&mut found),
                Some(_) if score - slack >= threshold => whole(&mut found),
                Some(exact) if score + slack >= threshold => {
                    found.n_rows_undecided += 1;
                    for index in runs_inside(shard, filter, shard.members(row)).flatten() {
                        found.n_rescored += 1;
                        let score = self.exact_score(exact.embeddings, index);
                        if score >= threshold {
                            let start = index as u32;
                            found.n_gaussians += 1;
                            found.runs.push(Run { shard: shard_at as u32, start, end: start + 1, score });
                        }
                    }
                }
                _ => {}
            }
        }
        found.n_shards_below = usize::from(!reachable);
        found
    }

    fn exact_score(&self, embeddings: &[half::f16], index: usize) -> f32 {
        let dim = self.query.len();
        dot(&embeddings[index * dim..][..dim], self.query)
    }

    /// Returns the ball where the shard sticks out of it.
    fn filter(&self, shard: &ShardView<'_>) -> Option<Ball> {
        self.ball.filter(|ball| !ball.covers(&position_box(shard)))
    }

    /// Returns the shards that were searched (the others lie outside the ball).
    pub fn searched(&self) -> impl Iterator<Item = &'a ShardView<'a>> {
        self.shards
            .iter()
            .zip(&self.row_scores)
            .filter(|(_, scores)| scores.is_some())
            .map(|(shard, _)| shard)
    }

    /// Returns the bound on the error of scores: for every Gaussian searched,
    /// `|row score - q·E_k|` is at most this.
    pub fn score_error_bound(&self) -> f32 {
        let largest = self.searched().flat_map(|shard| shard.radii).fold(0.0, |a: f32, b| a.max(*b));
        largest + rounding_bound(self.query.len())
    }

    /// Whether membership is exact: every shard searched carries exact embeddings.
    pub fn is_exact(&self) -> bool {
        self.searched().all(|shard| shard.exact.is_some())
    }
}

/// Returns the box that a shard's decoded positions can reach.
pub fn position_box(shard: &ShardView<'_>) -> Aabb {
    let min = DVec3::from(shard.header.origin_in_world);
    Aabb { min, max: min + f64::from(u16::MAX) * DVec3::from(shard.header.position_step) }
}

/// Returns the parts of a range of Gaussians that lie inside the filter.
fn runs_inside(
    shard: &ShardView<'_>,
    filter: Option<Ball>,
    members: Range<usize>,
) -> impl Iterator<Item = Range<usize>> {
    let mut at = members.start;
    std::iter::from_fn(move || {
        let Some(ball) = filter else {
            let rest = at..members.end;
            at = members.end;
            return (!rest.is_empty()).then_some(rest);
        };
        let inside = |index: &usize| ball.contains(shard.position_in_world(*index));
        let start = (at..members.end).find(inside)?;
        at = (start..members.end).find(|index| !inside(index)).unwrap_or(members.end);
        Some(start..at)
    })
}

#[cfg(test)]
mod tests;
