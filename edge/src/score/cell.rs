//! One question's view of one shard: the data that decide members' scores, and bounds on those scores.

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{ExactColumns, Residuals, ShardView};
use slag_math::simd::InstructionSet;

use super::project::Projection;
use super::question::Precision;
use super::region::Region;
use super::search::{Search, ShardScores};

/// Number of mean measured errors within which a score is undecided and refined. With 9, answers hold 0.99 and more
/// of a generated field's best 1,000 to 100,000; with 6, the best 1,000 of a few texts fall short, because so few
/// scores have the largest errors.
pub(super) const UNDECIDED: f32 = 9.0;

/// Largest distance of an f16-rounded unit embedding from the unrounded one that its centroid's radius refers to: half
/// a step of f16 at 1 (2^-11), plus the steps of components too small for f16's exponents.
pub(super) const F16_ROUNDING: f32 = 5e-4;

#[derive(Clone, Copy)]
pub(super) enum Detail<'a> {
    Nothing,
    Residuals(Residuals<'a>),
    Embeddings(&'a [f16]),
    Measured(Measured<'a>),
}

/// Codes, fine residuals and embeddings, with the margin of each around the threshold.
#[derive(Clone, Copy)]
pub(super) struct Measured<'a> {
    pub residuals: Residuals<'a>,
    pub exact: ExactColumns<'a>,
    pub code_margin: f32,
    pub fine_margin: f32,
}

impl<'a> Measured<'a> {
    /// `n_products`: number of products that a score is the difference of.
    fn new(
        shard: &ShardView<'a>,
        residuals: Residuals<'a>,
        exact: ExactColumns<'a>,
        n_products: f32,
    ) -> Self {
        let margin = |mean: f32| UNDECIDED * n_products * mean;
        Self {
            residuals,
            exact,
            code_margin: margin(shard.header.errors.mean),
            fine_margin: margin(exact.fine.map_or(0.0, |fine| fine.errors.mean)),
        }
    }
}

pub(super) struct Cell<'a> {
    pub at: u32,
    pub shard: &'a ShardView<'a>,
    pub asked: &'a Search<'a>,
    pub scores: &'a ShardScores,
    /// `[K]`: the question's score of each centroid.
    pub centroids: &'a [f32],
    pub detail: Detail<'a>,
    /// The region; absent if it covers the shard.
    pub filter: Option<Region>,
    pub instructions: InstructionSet,
    /// Most that a score changes with a residual of length 1, in components.
    component_steepness: f32,
    /// Rounding error of the tables for a centroid scale of 1.
    table_error: f32,
    /// Sum over vectors of the largest table value, for a centroid scale of 1.
    table_reach: f32,
}

impl<'a> Search<'a> {
    /// Returns the question's view of a shard; `None` if the shard was not searched.
    pub(super) fn cell(&'a self, at: usize) -> Option<Cell<'a>> {
        let (shard, scores) = (&self.shards[at], self.scored[at].as_ref()?);
        let detail = match (&shard.exact, &shard.residuals) {
            _ if self.precision == Precision::Centroids => Detail::Nothing,
            // Codes with unmeasured errors cannot decide.
            (Some(exact), Some(residuals))
                if self.precision == Precision::Measured && shard.header.errors.mean > 0.0 =>
            {
                let n_products = if self.places.len() == 1 { 1.0 } else { 2.0 };
                Detail::Measured(Measured::new(shard, *residuals, *exact, n_products))
            }
            (Some(exact), _) => Detail::Embeddings(exact.embeddings),
            (None, Some(residuals)) => Detail::Residuals(*residuals),
            (None, None) => Detail::Nothing,
        };
        let filter = (!self.region.covers(&shard.position_box())).then(|| self.region.clone());
        let mut cell = Cell {
            at: at as u32,
            shard,
            asked: self,
            scores,
            centroids: &scores.combined[self.index],
            detail,
            filter,
            instructions: InstructionSet::widest(),
            component_steepness: 0.0,
            table_error: 0.0,
            table_reach: 0.0,
        };
        if let Some(residuals) = &shard.residuals {
            cell.measure(residuals);
        }
        Some(cell)
    }

    /// Bounds every score's difference from the score of any embedding that the centroid or Gaussian represents.
    pub fn score_error_bound(&self) -> f32 {
        let of_cell = |cell: Cell<'_>| {
            (0..cell.centroids.len()).map(|centroid| cell.score_error(centroid)).fold(0.0, f32::max)
        };
        let cells = (0..self.shards.len()).into_par_iter().filter_map(|at| self.cell(at));
        cells.map(of_cell).reduce(|| 0.0, f32::max)
    }
}

impl Cell<'_> {
    /// Returns whether a member's score may differ from its centroid's.
    pub(crate) fn has_detail(&self) -> bool {
        !matches!(self.detail, Detail::Nothing)
    }

    pub(crate) fn projections(&self) -> impl Iterator<Item = &Projection> {
        self.asked.places.iter().map(|place| &self.scores.projections[*place])
    }

    fn measure(&mut self, residuals: &Residuals<'_>) {
        // Components outside all subspaces do not take part.
        let n_coded = residuals.subspace_starts.last().map_or(0, |end| *end as usize);
        let mut projections = self.projections();
        let own = projections.next().map_or(&[][..], |own| &own.components[..n_coded]);
        let length = |squares: f64| (squares.sqrt() * (1.0 + f64::from(f32::EPSILON))) as f32;
        let apart =
            |other: &Projection| own.iter().zip(&other.components).map(|(a, b)| (a - b).powi(2)).sum();
        let largest = projections.map(apart).reduce(f64::max);
        let steepness = length(largest.unwrap_or_else(|| own.iter().map(|v| v * v).sum()));
        let error = |negative: bool| {
            let errors = self.projections().enumerate().filter(|(at, _)| (*at > 0) == negative);
            errors.map(|(_, projection)| projection.tables.error).fold(0.0, f32::max)
        };
        let table_error = error(false) + error(true);
        let reach = |p: &Projection| p.tables.offset.abs() + p.tables.step * f32::from(p.tables.most);
        let table_reach = self.projections().map(reach).sum();
        (self.component_steepness, self.table_error, self.table_reach) =
            (steepness, table_error, table_reach);
    }

    /// Returns a member's score by one vector for a code sum of 0, and the increase per step of the sum.
    pub fn line(&self, place: usize, centroid: usize, residuals: &Residuals<'_>) -> (f32, f32) {
        let (tables, scale) = (&self.scores.projections[place].tables, residuals.residual_scales[centroid]);
        (self.scores.centroids[place][centroid] + scale * tables.offset, scale * tables.step)
    }

    /// Returns the largest difference between a member's score and its centroid's under the residual code.
    fn residual_bound(&self, centroid: usize, residuals: &Residuals<'_>) -> f32 {
        let scale = residuals.residual_scales[centroid];
        let apart = residuals.residual_norms[centroid] * self.component_steepness + scale * self.table_error;
        // Three roundings in each line, and those of the bound itself.
        apart * (1.0 + 4.0 * f32::EPSILON) + self.rounding(centroid, residuals)
    }

    fn rounding(&self, centroid: usize, residuals: &Residuals<'_>) -> f32 {
        let of_centroids: f32 =
            self.asked.places.iter().map(|place| self.scores.centroids[*place][centroid].abs()).sum();
        2.0 * f32::EPSILON * (of_centroids + residuals.residual_scales[centroid] * self.table_reach)
    }

    pub fn bounds(&self, centroid: usize) -> (f32, f32) {
        let score = self.centroids[centroid];
        match &self.detail {
            Detail::Nothing => (score, score),
            Detail::Embeddings(_) => {
                let slack = self.embedding_bound(centroid);
                (score - slack, score + slack)
            }
            Detail::Residuals(residuals) | Detail::Measured(Measured { residuals, .. }) => {
                let apart = self.residual_bound(centroid, residuals);
                if let [place] = self.asked.places[..] {
                    let (least, step) = self.line(place, centroid, residuals);
                    let most = least + step * f32::from(self.scores.projections[place].tables.most);
                    return (least.max(score - apart), most.min(score + apart));
                }
                let ends = |place: &usize| {
                    let (least, step) = self.line(*place, centroid, residuals);
                    let most = self.scores.projections[*place].tables.most;
                    (least, least + step * f32::from(most))
                };
                let mut all = self.asked.places.iter().map(ends);
                let (mut lower, mut upper) = all.next().unwrap_or_default();
                if let Some((least, most)) = all.reduce(|a, b| (a.0.max(b.0), a.1.max(b.1))) {
                    (lower, upper) = (lower - most, upper - least);
                }
                (lower.max(score - apart), upper.min(score + apart))
            }
        }
    }

    /// Returns the largest difference between the score of a stored embedding and that of its centroid.
    pub(crate) fn embedding_bound(&self, centroid: usize) -> f32 {
        let question = self.asked.question;
        let distance = self.shard.radii[centroid] + F16_ROUNDING;
        self.asked.steepness * distance + 2.0 * question.rounding_bound() + self.centroid_error(centroid)
    }

    pub(crate) fn centroid_error(&self, centroid: usize) -> f32 {
        let error = |projection: &Projection| {
            // Members have unit length, so neither the centroid nor their distance from it is longer than 1.
            let length = 1.0 + self.shard.radii[centroid] + projection.mean_length;
            projection.error_per_length * length + projection.error + f32::EPSILON * (1.0 + length)
        };
        let mut errors = self.projections().map(error);
        errors.next().unwrap_or(0.0) + errors.fold(0.0, f32::max)
    }

    /// Bounds the error of the centroid's score, or of its members' scores if a residual code gives them their own.
    pub fn score_error(&self, centroid: usize) -> f32 {
        let of_centroids = self.asked.steepness * self.shard.radii[centroid] + self.centroid_error(centroid);
        let of_codes = |residuals: &Residuals<'_>| {
            of_centroids
                + residuals.residual_scales[centroid] * self.table_error
                + self.rounding(centroid, residuals)
        };
        match (&self.detail, &self.shard.residuals) {
            (Detail::Residuals(residuals), _) => of_codes(residuals),
            // With exact embeddings present, radii are measured to the centroid.
            (Detail::Measured(Measured { residuals, .. }), _) => {
                let by_code =
                    of_codes(residuals) + residuals.residual_norms[centroid] * self.component_steepness;
                // Both the score and the true value lie within that bound of the centroid's score.
                by_code.max(2.0 * self.embedding_bound(centroid))
            }
            // Radii are measured to the vector that centroid and code decode to.
            (_, Some(residuals)) if self.shard.exact.is_none() => {
                of_centroids + residuals.residual_norms[centroid] * self.component_steepness
            }
            _ => of_centroids,
        }
    }
}
