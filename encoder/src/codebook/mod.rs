//! Stage 5: an error-bounded codebook per cell, and a residual code where one centroid is not enough.
//!
//! Embeddings cluster strongly, so a cell stores K centroids, and each Gaussian belongs to one. Centroids and
//! residuals are stored in the cell's own coordinates ([`basis`]), in which equal distances are equal errors of
//! scores. K and the length of the code follow from the requested errors ([`cluster`], [`residual`]); a few
//! centroids more bring the farthest Gaussians nearer ([`outliers`]). Hard radii are computed from the full
//! embeddings; errors of scores are measured over a bank of texts ([`measure`]).

pub mod basis;
pub mod cluster;
pub mod measure;
mod outliers;
pub(crate) mod residual;

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{self, ScoreErrors};

use basis::{Basis, MAX_COMPONENTS};
use cluster::{Clusters, Members};
use measure::{Decoder, Reference, ScoreMoments};
use residual::ResidualCode;
use slag_math::matrix::{Panels, Rows};

pub use basis::{ScoreMetric, TextBank};
pub(crate) use residual::FineResiduals;

/// Ratio of the root mean square of errors to their mean absolute value: 1.3 to 1.4 measured on the labelled
/// house, whose errors have heavy tails; 1.25 for normally distributed errors.
const RMS_OF_MEAN: f32 = 1.35;
/// Bytes of a centroid in a compact shard beside its components: start and radius.
const BYTES_BESIDE_COMPONENTS: usize = 8;
/// One outlier centroid per this many components of an embedding, in a cell of any size: a sixteenth of the bytes of
/// its basis.
const OUTLIERS_OF_DIM: usize = 16;
const CENTROID_STEP: f32 = 1.0 / 127.0;
/// Share of the residual code's error budget for the dimensions without a component.
const TAIL_SHARE: f32 = 0.3;

/// Most bytes per embedding while building a codebook: components, residuals, codes.
pub(crate) fn working_bytes_per_embedding(dim: usize) -> usize {
    4 * dim.min(128) * size_of::<f32>() + 64
}

/// How fine a codebook is. Errors are means of `|score error|`, relative to the spread of scores (their
/// standard deviation over the scene).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CodebookSettings {
    pub(crate) compact_error: f32,
    pub(crate) balanced_error: f32,
    /// Most components of a centroid: the dimension of compact and balanced shards. Fewer are taken where the
    /// errors allow it; even, 2 to [`MAX_COMPONENTS`].
    pub(crate) max_components: usize,
    /// Fewest Gaussians per centroid, on average.
    pub(crate) min_gaussians_per_centroid: usize,
    /// Bytes per Gaussian that centroids of outliers may take, beside a sixteenth of the basis: they lower the
    /// hard bound of scores. 0: no such centroids.
    pub(crate) outlier_bytes: f32,
    /// Most subspaces of the residual code (half a byte each); below 2 there is no code.
    pub(crate) max_subspaces: usize,
    /// Whether residuals are also stored in 8 bits per component, as in exact shards.
    pub(crate) has_fine: bool,
}

impl Default for CodebookSettings {
    /// On the labelled house, 0.1 keeps the exact field's task accuracy, and 0.02 its ranking (README.md).
    fn default() -> Self {
        Self {
            compact_error: 0.1,
            balanced_error: 0.02,
            max_components: MAX_COMPONENTS,
            min_gaussians_per_centroid: 45,
            outlier_bytes: 0.25,
            max_subspaces: 32,
            has_fine: false,
        }
    }
}

/// Metric and texts by which errors of scores are measured.
pub struct ScoreMetricContext {
    pub metric: ScoreMetric,
    pub bank: TextBank,
    /// Spread of a text's scores over the scene, estimated beforehand.
    pub spread: f32,
}

/// Gaussians are in the order of the centroids.
pub struct Codebook {
    /// `[n]`: the given embeddings in the order of the centroids, then as given.
    pub order: Vec<u32>,
    /// `[K + 1]`.
    pub centroid_starts: Vec<u32>,
    pub n_components: usize,
    /// `[dim]`.
    pub mean: Vec<f16>,
    /// `[m][dim]`.
    pub basis: Vec<i8>,
    /// `[m]`.
    pub(crate) basis_steps: Vec<f32>,
    /// `[K][m]`.
    pub centroids: Vec<i8>,
    pub centroid_step: f32,
    /// `[K]`: largest distance of a member from its centroid.
    pub radii: Vec<f32>,
    pub errors: ScoreErrors,
    pub moments: ScoreMoments,
    /// `None` if the centroids are good enough.
    pub residuals: Option<CodebookResiduals>,
}

impl Codebook {
    pub(crate) fn stored_basis(&self) -> shard::Basis<'_> {
        shard::Basis { mean: &self.mean, vectors: &self.basis, steps: &self.basis_steps }
    }

    pub(crate) fn fine(&self) -> Option<shard::Fine<'_>> {
        let FineResiduals { steps, scales, values, errors } = self.residuals.as_ref()?.fine.as_ref()?;
        Some(shard::Fine { errors: *errors, steps, scales, values })
    }
}

pub struct CodebookResiduals {
    pub code: ResidualCode,
    /// `[K]`.
    pub residual_scales: Vec<f32>,
    /// `[K]`.
    pub residual_norms: Vec<f32>,
    /// `[ceil(n / 32)][G / 2][32]`.
    pub codes: Vec<u8>,
    /// `[K]`: largest distance of a member from its decoded form.
    pub radii: Vec<f32>,
    pub errors: ScoreErrors,
    pub fine: Option<FineResiduals>,
}

/// Takes unit embeddings. The result does not depend on threads.
pub fn build(
    embeddings: Rows<'_>,
    score_context: &ScoreMetricContext,
    settings: &CodebookSettings,
) -> Codebook {
    let rms = |error: f32| error * RMS_OF_MEAN * score_context.spread;
    let (mut basis, mut points, found) = clustered(embeddings, score_context, settings);
    let m = basis.n_components;
    let members = Members::new(&found.codes, found.centres.len() / m);
    let scales = scale_residuals(&mut points, &found, &members, m);
    let (max_rms, max_subspaces) = (rms(settings.balanced_error), settings.max_subspaces);
    let (code, turn) = plan_code(Rows::all(&points, m), &scales, &found.codes, max_rms, max_subspaces);
    basis.rotate(&turn);
    let centres = Panels::new(m, m, |old, new| turn[new * m + old]).product(Rows::all(&found.centres, m));
    let stored = StoredCentroids::new(&basis, &centres, &scales);
    let decoded_centroids = stored.decoded();
    let sample = measure::Sample::new(embeddings, &members.order, &score_context.bank);
    let reference =
        Reference { embeddings, members: &members, decoded_centroids: &decoded_centroids, sample: &sample };
    let (radii, errors) = reference.compare(None);
    let residuals =
        code.map(|code| code_residuals(code, &reference, &basis, &stored, scales, settings.has_fine));
    let moments = sample.moments;
    let StoredCentroids { basis: vectors, basis_steps, centroids, .. } = stored;
    let Members { order, starts: centroid_starts } = members;
    Codebook {
        order,
        centroid_starts,
        n_components: m,
        mean: basis.mean,
        basis: vectors,
        basis_steps,
        centroids,
        centroid_step: CENTROID_STEP,
        radii,
        errors,
        moments,
        residuals,
    }
}

/// Basis, the embeddings' components in it (`[n][m]`), and their clusters.
fn clustered(
    embeddings: Rows<'_>,
    context: &ScoreMetricContext,
    settings: &CodebookSettings,
) -> (Basis, Vec<f32>, Clusters) {
    let (n, dim) = (embeddings.len(), embeddings.width);
    let rms = |error: f32| error * RMS_OF_MEAN * context.spread;
    let tolerance = TAIL_SHARE * rms(settings.balanced_error);
    let basis = Basis::fit(embeddings, &context.metric, tolerance, settings.max_components);
    let m = basis.n_components;
    let points = basis.components(embeddings);
    let rows = Rows::all(&points, m);
    let max_centroids = (n / settings.min_gaussians_per_centroid.max(1)).max(1);
    let mut found = cluster::clusters(rows, rms(settings.compact_error), max_centroids);
    if settings.outlier_bytes > 0.0 {
        let n_more = settings.outlier_bytes * n as f32 / (m + BYTES_BESIDE_COMPONENTS) as f32;
        let n_more = n_more as usize + dim / OUTLIERS_OF_DIM;
        // A bound within the spread of scores tells them apart.
        outliers::separate(embeddings, &basis, rows, &mut found, n_more, context.spread);
    }
    (basis, points, found)
}

/// Subtracts from each point its centroid, and divides it by the RMS of the centroid's residuals; returns these, `[K]`.
fn scale_residuals(points: &mut [f32], found: &Clusters, members: &Members, m: usize) -> Vec<f32> {
    points.par_chunks_exact_mut(m).zip(&found.codes).for_each(|(point, centroid)| {
        let centre = &found.centres[*centroid as usize * m..][..m];
        point.iter_mut().zip(centre).for_each(|(p, c)| *p -= c);
    });
    let in_order = Rows { values: &*points, width: m, index: Some(&members.order) };
    let squares = |place: usize| in_order.get(place).iter().map(|v| f64::from(v * v)).sum::<f64>();
    let scale = |centroid: usize| {
        let places = members.places(centroid);
        let n = places.len() as f64;
        // At least 1e-6, against division by zero where members coincide.
        ((places.map(squares).sum::<f64>() / n).sqrt() as f32).max(1e-6)
    };
    let scales: Vec<f32> = (0..members.starts.len() - 1).into_par_iter().map(scale).collect();
    points.par_chunks_exact_mut(m).zip(&found.codes).for_each(|(residual, centroid)| {
        let scale = scales[*centroid as usize].recip();
        residual.iter_mut().for_each(|v| *v *= scale);
    });
    scales
}

/// Residual code, if needed, and the rotation (rows `[m][m]`) to the residuals' eigenvectors in its order.
fn plan_code(
    residuals: Rows<'_>,
    scales: &[f32],
    codes: &[u32],
    max_rms: f32,
    max_subspaces: usize,
) -> (Option<ResidualCode>, Vec<f32>) {
    let m = residuals.width;
    let (turn, variances) = residual::rotation(residuals);
    let turned = Panels::new(m, m, |old, new| turn[new * m + old]).product(residuals);
    let scale_of: Vec<f32> = codes.iter().map(|centroid| scales[*centroid as usize]).collect();
    let planned = residual::plan(Rows::all(&turned, m), &scale_of, &variances, max_rms, max_subspaces);
    let (order, code) = match planned {
        Some((order, code)) => (order, Some(code)),
        None => ((0..m).collect(), None),
    };
    (code, order.iter().flat_map(|c| &turn[c * m..][..m]).copied().collect())
}

/// Centroids and basis in 8 bits; each component's range goes into its basis vector.
struct StoredCentroids<'a> {
    mean: &'a [f16],
    /// `[m]`: value of a component of 1.
    ranges: Vec<f32>,
    basis: Vec<i8>,
    basis_steps: Vec<f32>,
    centroids: Vec<i8>,
}

impl<'a> StoredCentroids<'a> {
    fn new(fitted: &'a Basis, centres: &[f32], scales: &[f32]) -> Self {
        let (m, dim) = (fitted.n_components, fitted.mean.len());
        let ranges = ranges(centres, m, scales);
        let centroids =
            centres.iter().enumerate().map(|(at, v)| (v / ranges[at % m] * 127.0).round() as i8).collect();
        let (mut basis, mut basis_steps) = (Vec::with_capacity(m * dim), Vec::with_capacity(m));
        for (vector, range) in fitted.basis.chunks_exact(dim).zip(&ranges) {
            let scaled: Vec<f32> = vector.iter().map(|v| v * range).collect();
            let (values, step) = shard::quantise(&scaled);
            basis.extend(values);
            basis_steps.push(step);
        }
        Self { mean: &fitted.mean, ranges, basis, basis_steps, centroids }
    }

    fn decoder(&self, m: usize) -> Decoder<'_> {
        let dim = self.mean.len();
        Decoder { dim, m, mean: self.mean, basis: &self.basis[..m * dim], steps: &self.basis_steps[..m] }
    }

    /// The centroids as readers decode them, `[K][dim]`.
    fn decoded(&self) -> Vec<f32> {
        let components: Vec<f32> = self.centroids.iter().map(|v| f32::from(*v) * CENTROID_STEP).collect();
        self.decoder(self.ranges.len()).decode(&components)
    }
}

/// Largest absolute value of each component. A lower bound keeps residuals in the range of half floats and readers.
fn ranges(centres: &[f32], m: usize, scales: &[f32]) -> Vec<f32> {
    let largest_scale = scales.iter().copied().fold(0.0, f32::max);
    let mut ranges = vec![(largest_scale / 8.0).max(1e-3); m];
    for centre in centres.chunks_exact(m) {
        ranges.iter_mut().zip(centre).for_each(|(range, v)| *range = range.max(v.abs()));
    }
    ranges
}

/// Codes the residuals of the stored centroids, and measures what readers decode.
fn code_residuals(
    code: ResidualCode,
    reference: &Reference<'_>,
    fitted: &Basis,
    stored: &StoredCentroids<'_>,
    scales: Vec<f32>,
    has_fine: bool,
) -> CodebookResiduals {
    let (m, ranges, members) = (fitted.n_components, &stored.ranges, reference.members);
    let residuals = residuals_of_stored(reference, fitted, &scales);
    let fine = has_fine.then(|| {
        let (fine, decoded) = residual::round(&residuals, m, &members.starts, &scales, ranges);
        let (_, errors) = reference.compare(Some((&stored.decoder(m), &decoded)));
        FineResiduals { errors, ..fine }
    });
    let (codes, mut decoded) = code.encode(Rows::all(&residuals, m));
    let covered = code.n_components();
    // As readers decode: in the centroids' units, times their scales.
    let mut residual_norms = vec![0.0f32; scales.len()];
    for centroid in 0..scales.len() {
        for at in members.places(centroid) {
            let decoded = &mut decoded[at * covered..][..covered];
            decoded.iter_mut().zip(ranges).for_each(|(v, range)| {
                *v = f16::from_f32(*v / range).to_f32() * scales[centroid];
            });
            let length = decoded.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            residual_norms[centroid] = residual_norms[centroid].max((length as f32).next_up());
        }
    }
    let (radii, errors) = reference.compare(Some((&stored.decoder(covered), &decoded)));
    let code = code.divided(ranges);
    CodebookResiduals { code, residual_scales: scales, residual_norms, codes, radii, errors, fine }
}

/// Residuals of the stored centroids, in the order of the members, divided by the centroids' scales.
fn residuals_of_stored(reference: &Reference<'_>, basis: &Basis, scales: &[f32]) -> Vec<f32> {
    let Reference { embeddings, members, decoded_centroids, .. } = *reference;
    let (m, dim) = (basis.n_components, embeddings.width);
    let in_order: Vec<u32> =
        members.order.iter().map(|at| embeddings.index.map_or(*at, |index| index[*at as usize])).collect();
    let mut points = basis.components(Rows { index: Some(&in_order), ..embeddings });
    let centroids = basis.components(Rows::all(decoded_centroids, dim));
    for centroid in 0..scales.len() {
        let (scale, places) = (scales[centroid].recip(), members.places(centroid));
        for point in points[places.start * m..places.end * m].chunks_exact_mut(m) {
            point.iter_mut().zip(&centroids[centroid * m..]).for_each(|(p, r)| *p = (*p - r) * scale);
        }
    }
    points
}

#[cfg(test)]
mod tests;
