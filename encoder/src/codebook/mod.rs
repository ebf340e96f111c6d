//! Stage 5: an error-bounded codebook per cell, and a residual code where one centroid is not enough.
//!
//! Embeddings cluster strongly, so a cell stores K centroids, and each Gaussian belongs to one. Centroids and residuals are
//! stored in the cell's own coordinates ([`basis`]), in which equal distances are equal errors of scores. K and the
//! length of the code follow from the requested errors ([`cluster`], [`residual`]); a few centroids more bring the farthest
//! Gaussians nearer ([`outliers`]). Hard radii are computed from the
//! full embeddings; errors of scores are measured over a bank of texts ([`measure`]).

pub mod basis;
pub mod cluster;
mod compare;
mod decoder;
mod fine;
pub mod measure;
mod outliers;
pub mod residual;
mod settings;

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{self, ScoreErrors};

use basis::Basis;
use compare::compare;
use decoder::Decoder;
use measure::ScoreMoments;
use residual::ResidualCode;
use slag_math::matrix::{Panels, Rows};

pub use basis::{ScoreMetric, TextBank};
pub use fine::FineResiduals;
pub use settings::CodebookSettings;

/// Ratio of the root mean square of errors to their mean absolute value: 1.3 to 1.4 measured on the labelled house, whose
/// errors have heavy tails; 1.25 for normally distributed errors.
const RMS_OF_MEAN: f32 = 1.35;
/// Bytes of a centroid in a compact shard beside its components: start and radius.
const BYTES_BESIDE_COMPONENTS: usize = 8;
/// One centroid of an outlier for so many components of an embedding, in a cell of any size: a sixteenth of the bytes of its basis.
const OUTLIERS_OF_DIM: usize = 16;
/// Share of the residual code's error budget that the dimensions without a component may take.
const TAIL_SHARE: f32 = 0.3;

/// Returns the most bytes per embedding that building a codebook takes: components, residuals, codes.
pub fn working_bytes_per_embedding(dim: usize) -> usize {
    4 * dim.min(128) * size_of::<f32>() + 64
}

/// The metric and the texts that errors of scores are measured by.
pub struct ScoreMetricContext {
    /// Metric of score errors.
    pub metric: ScoreMetric,
    /// Texts whose scores are compared.
    pub bank: TextBank,
    /// Spread of a text's scores over the scene, as estimated beforehand.
    pub spread: f32,
}

/// A cell's centroids and their members. Gaussians are in the order of the centroids.
pub struct Codebook {
    /// `[n]`: the given embeddings in the order of the centroids, then as given.
    pub order: Vec<u32>,
    /// `[K + 1]`.
    pub centroid_starts: Vec<u32>,
    /// Components of a centroid, m.
    pub n_components: usize,
    /// `[dim]`.
    pub mean: Vec<f16>,
    /// `[m][dim]`.
    pub basis: Vec<i8>,
    /// `[m]`.
    pub basis_steps: Vec<f32>,
    /// `[K][m]`.
    pub centroids: Vec<i8>,
    /// Step of the centroids' components.
    pub centroid_step: f32,
    /// `[K]`: largest distance of a member from its centroid.
    pub radii: Vec<f32>,
    /// Errors of the centroids' scores.
    pub errors: ScoreErrors,
    /// Moments of all texts' scores.
    pub moments: ScoreMoments,
    /// The residual code; `None` if the centroids are good enough.
    pub residuals: Option<CodebookResiduals>,
}

/// The residual code of a codebook.
pub struct CodebookResiduals {
    /// Subspaces and codewords.
    pub code: ResidualCode,
    /// `[K]`.
    pub residual_scales: Vec<f32>,
    /// `[K]`.
    pub residual_norms: Vec<f32>,
    /// `[ceil(n / 32)][G / 2][32]`.
    pub codes: Vec<u8>,
    /// `[K]`: largest distance of a member from its decoded form.
    pub radii: Vec<f32>,
    /// Errors of the decoded scores.
    pub errors: ScoreErrors,
    /// Residuals in 8 bits, if requested.
    pub fine: Option<FineResiduals>,
}

/// Builds the codebook of some unit embeddings. The result does not depend on threads.
pub fn build(
    embeddings: Rows<'_>,
    score_context: &ScoreMetricContext,
    settings: &CodebookSettings,
) -> Codebook {
    let dim = embeddings.width;
    let rms = |error: f32| error * RMS_OF_MEAN * score_context.spread;
    let tolerance = TAIL_SHARE * rms(settings.balanced_error);
    let mut fitted = Basis::fit(embeddings, &score_context.metric, tolerance, settings.max_components);
    let m = fitted.n_components;
    let points = fitted.components(embeddings);
    let max_centroids = (embeddings.len() / settings.min_gaussians_per_centroid.max(1)).max(1);
    let mut found = cluster::clusters(Rows::all(&points, m), rms(settings.compact_error), max_centroids);
    if settings.outlier_bytes > 0.0 {
        let n_more = settings.outlier_bytes * embeddings.len() as f32 / (m + BYTES_BESIDE_COMPONENTS) as f32;
        let n_more = n_more as usize + dim / OUTLIERS_OF_DIM;
        // A bound within the spread of scores tells them apart.
        outliers::separate(
            embeddings,
            &fitted,
            Rows::all(&points, m),
            &mut found,
            n_more,
            score_context.spread,
        );
    }
    let (order, centroid_starts) = sorted(&found.codes, found.centres.len() / m);

    // Rotated to the residuals' eigenvectors; each residual is divided by its centroid's scale.
    let mut residuals = points;
    residuals.par_chunks_exact_mut(m).zip(&found.codes).for_each(|(point, centroid)| {
        let centre = &found.centres[*centroid as usize * m..][..m];
        point.iter_mut().zip(centre).for_each(|(p, c)| *p -= c);
    });
    let scales =
        residual_scales(Rows { values: &residuals, width: m, index: Some(&order) }, &centroid_starts);
    residuals.par_chunks_exact_mut(m).zip(&found.codes).for_each(|(residual, centroid)| {
        let scale = scales[*centroid as usize].recip();
        residual.iter_mut().for_each(|v| *v *= scale);
    });
    let (turn, variances) = residual::rotation(Rows::all(&residuals, m));
    let turned =
        |vectors: &[f32]| Panels::new(m, m, |old, new| turn[new * m + old]).product(Rows::all(vectors, m));
    let residuals = turned(&residuals);
    let scale_of: Vec<f32> = found.codes.iter().map(|centroid| scales[*centroid as usize]).collect();
    let planned = residual::plan(
        Rows::all(&residuals, m),
        &scale_of,
        &variances,
        rms(settings.balanced_error),
        settings.max_subspaces,
    );
    drop(residuals);
    let components_in_order: Vec<usize> = match &planned {
        Some((order, _)) => order.clone(),
        None => (0..m).collect(),
    };
    let turn: Vec<f32> = components_in_order.iter().flat_map(|c| &turn[c * m..][..m]).copied().collect();
    fitted.rotate(&turn);

    // Centroids in 8 bits: each component has its own range, which goes into its basis vector.
    let centres = Panels::new(m, m, |old, new| turn[new * m + old]).product(Rows::all(&found.centres, m));
    let ranges = ranges(&centres, m, &scales);
    let centroid_step = 1.0 / 127.0;
    let centroids: Vec<i8> =
        centres.iter().enumerate().map(|(at, v)| (v / ranges[at % m] * 127.0).round() as i8).collect();
    let (mut basis, mut basis_steps) = (Vec::with_capacity(m * dim), Vec::with_capacity(m));
    for (vector, range) in fitted.basis.chunks_exact(dim).zip(&ranges) {
        let scaled: Vec<f32> = vector.iter().map(|v| v * range).collect();
        let (values, step) = shard::quantise(&scaled);
        basis.extend(values);
        basis_steps.push(step);
    }
    let decoder = Decoder { dim, m, mean: &fitted.mean, basis: &basis, steps: &basis_steps };
    let decoded_centroids =
        decoder.decode(&centroids.iter().map(|v| f32::from(*v) * centroid_step).collect::<Vec<_>>(), true);

    let measured = measure::Sample::new(embeddings, &order, &score_context.bank);
    let (radii, errors) = compare(embeddings, &order, &centroid_starts, &decoded_centroids, None, &measured);
    let residuals = planned.map(|(_, code)| {
        let coded = coded(embeddings, &fitted, &order, &centroid_starts, &decoded_centroids, &scales);
        let fine = settings.has_fine.then(|| {
            let (fine, decoded) = fine::round(&coded, m, &centroid_starts, &scales, &ranges);
            let (_, errors) = compare(
                embeddings,
                &order,
                &centroid_starts,
                &decoded_centroids,
                Some((&decoder, &decoded)),
                &measured,
            );
            FineResiduals { errors, ..fine }
        });
        let (codes, mut decoded) = code.encode(Rows::all(&coded, m));
        let covered = code.n_components();
        // As readers decode: in the centroids' units, multiplied by the centroids' scales.
        let mut residual_norms = vec![0.0f32; scales.len()];
        let mut codewords = code.codewords.clone();
        for starts in code.subspace_starts.windows(2) {
            let (from, to) = (starts[0] as usize, starts[1] as usize);
            for (at, codeword) in
                codewords[shard::CODEWORDS * from..shard::CODEWORDS * to].iter_mut().enumerate()
            {
                *codeword = f16::from_f32(codeword.to_f32() / ranges[from + at % (to - from)]);
            }
        }
        for centroid in 0..scales.len() {
            for at in centroid_starts[centroid] as usize..centroid_starts[centroid + 1] as usize {
                let decoded = &mut decoded[at * covered..][..covered];
                decoded.iter_mut().zip(&ranges).for_each(|(v, range)| {
                    *v = f16::from_f32(*v / range).to_f32() * scales[centroid];
                });
                let length = decoded.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
                residual_norms[centroid] = residual_norms[centroid].max((length as f32).next_up());
            }
        }
        let part =
            Decoder { m: covered, basis: &basis[..covered * dim], steps: &basis_steps[..covered], ..decoder };
        let (radii, errors) = compare(
            embeddings,
            &order,
            &centroid_starts,
            &decoded_centroids,
            Some((&part, &decoded)),
            &measured,
        );
        let code = ResidualCode { codewords, ..code };
        CodebookResiduals { code, residual_scales: scales, residual_norms, codes, radii, errors, fine }
    });
    let Basis { mean, .. } = fitted;
    Codebook {
        order,
        centroid_starts,
        n_components: m,
        mean,
        basis,
        basis_steps,
        centroids,
        centroid_step,
        radii,
        errors,
        moments: measured.moments,
        residuals,
    }
}

/// Returns the points ordered by centroid, and where the centroids start.
fn sorted(codes: &[u32], n_centroids: usize) -> (Vec<u32>, Vec<u32>) {
    let mut starts = vec![0u32; n_centroids + 1];
    codes.iter().for_each(|centroid| starts[*centroid as usize + 1] += 1);
    (0..n_centroids).for_each(|centroid| starts[centroid + 1] += starts[centroid]);
    let mut next = starts.clone();
    let mut order = vec![0; codes.len()];
    for (point, centroid) in codes.iter().enumerate() {
        order[next[*centroid as usize] as usize] = point as u32;
        next[*centroid as usize] += 1;
    }
    (order, starts)
}

/// Returns the root mean square of each centroid's residuals.
fn residual_scales(residuals: Rows<'_>, centroid_starts: &[u32]) -> Vec<f32> {
    centroid_starts
        .par_windows(2)
        .map(|members| {
            let squares = |at: usize| residuals.get(at).iter().map(|v| f64::from(v * v)).sum::<f64>();
            let members = members[0] as usize..members[1] as usize;
            let n = members.len() as f64;
            // At least 1e-6: members that coincide must not cause a division by zero.
            ((members.map(squares).sum::<f64>() / n).sqrt() as f32).max(1e-6)
        })
        .collect()
}

/// Returns the largest absolute value of each component. A lower bound keeps residuals within the range of half floats and
/// readers.
fn ranges(centres: &[f32], m: usize, scales: &[f32]) -> Vec<f32> {
    let largest_scale = scales.iter().copied().fold(0.0, f32::max);
    let mut ranges = vec![(largest_scale / 8.0).max(1e-3); m];
    for centre in centres.chunks_exact(m) {
        ranges.iter_mut().zip(centre).for_each(|(range, v)| *range = range.max(v.abs()));
    }
    ranges
}

/// Returns the residuals of the stored centroids, in shard order, divided by the centroids' scales.
fn coded(
    embeddings: Rows<'_>,
    basis: &Basis,
    order: &[u32],
    centroid_starts: &[u32],
    decoded_centroids: &[f32],
    scales: &[f32],
) -> Vec<f32> {
    let (m, dim) = (basis.n_components, embeddings.width);
    let in_order: Vec<u32> =
        order.iter().map(|at| embeddings.index.map_or(*at, |index| index[*at as usize])).collect();
    let mut points = basis.components(Rows { index: Some(&in_order), ..embeddings });
    let centroids = basis.components(Rows::all(decoded_centroids, dim));
    for (centroid, members) in centroid_starts.windows(2).enumerate() {
        let scale = scales[centroid].recip();
        for point in points[members[0] as usize * m..members[1] as usize * m].chunks_exact_mut(m) {
            point.iter_mut().zip(&centroids[centroid * m..]).for_each(|(p, r)| *p = (*p - r) * scale);
        }
    }
    points
}

#[cfg(test)]
mod tests;
