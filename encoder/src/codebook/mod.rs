//! Stage 5: an error-bounded codebook per cell, and a residual code where one centroid is not enough.
//!
//! Embeddings cluster strongly, so a cell stores K centroids, and each Gaussian belongs to one. Centroids and residuals are
//! stored in the cell's own coordinates ([`basis`]), in which equal distances are equal errors of scores. K and the
//! length of the code follow from the requested errors ([`cluster`], [`residual`]). Hard radii are computed from the
//! full embeddings; errors of scores are measured over a bank of texts ([`measure`]).

pub mod basis;
pub mod cluster;
pub mod measure;
pub mod residual;

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{self, ScoreErrors};

use basis::Basis;
pub use basis::{ScoreMetric, TextBank};
use measure::ScoreMoments;
use residual::ResidualCode;
use slag_math::matrix::{Panels, Rows};

/// Ratio of the root mean square of errors to their mean absolute value: 1.3 to 1.4 measured on the labelled house, whose
/// errors have heavy tails; 1.25 for normally distributed errors.
const RMS_OF_MEAN: f32 = 1.35;
/// Share of the residual code's error budget that the dimensions without a component may take.
const TAIL_SHARE: f32 = 0.3;
/// Embeddings decoded at a time.
const CHUNK: usize = 1024;

/// Returns the most bytes per embedding that building a codebook takes: components, residuals, codes.
pub fn working_bytes_per_embedding(dim: usize) -> usize {
    4 * dim.min(128) * size_of::<f32>() + 64
}

/// How fine a codebook is. Errors are means of `|score error|`, relative to the spread of scores (their
/// standard deviation over the scene).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CodebookSettings {
    /// Largest accepted error of the compact profile.
    pub compact_error: f32,
    /// Largest accepted error of the balanced profile.
    pub balanced_error: f32,
    /// Fewest Gaussians per centroid, on average.
    pub min_gaussians_per_centroid: usize,
    /// Most subspaces of the residual code (half a byte each); below 2 there is no code.
    pub max_subspaces: usize,
    /// Whether residuals are also stored in 8 bits per component, as in exact shards.
    pub has_fine: bool,
}

impl Default for CodebookSettings {
    /// On the labelled house, 0.1 keeps the exact field's task accuracy, and 0.02 its ranking (README.md).
    fn default() -> Self {
        Self {
            compact_error: 0.1,
            balanced_error: 0.02,
            min_gaussians_per_centroid: 45,
            max_subspaces: 32,
            has_fine: false,
        }
    }
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

/// Residuals in 8 bits a component.
pub struct FineResiduals {
    /// `[m]`.
    pub steps: Vec<f32>,
    /// `[K]`.
    pub scales: Vec<f32>,
    /// `[n][m]`.
    pub values: Vec<i8>,
    /// Errors of the decoded scores.
    pub errors: ScoreErrors,
}

/// Builds the codebook of some unit embeddings. The result does not depend on threads.
pub fn build(
    embeddings: Rows<'_>,
    score_context: &ScoreMetricContext,
    settings: &CodebookSettings,
) -> Codebook {
    let dim = embeddings.width;
    let rms = |error: f32| error * RMS_OF_MEAN * score_context.spread;
    let mut fitted = Basis::fit(embeddings, &score_context.metric, TAIL_SHARE * rms(settings.balanced_error));
    let m = fitted.n_components;
    let points = fitted.components(embeddings);
    let max_centroids = (embeddings.len() / settings.min_gaussians_per_centroid.max(1)).max(1);
    let found = cluster::clusters(Rows::all(&points, m), rms(settings.compact_error), max_centroids);
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
            let (fine, decoded) = fine(&coded, m, &centroid_starts, &scales, &ranges);
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

/// Decodes components to vectors, as readers do.
#[derive(Clone, Copy)]
struct Decoder<'a> {
    dim: usize,
    m: usize,
    mean: &'a [f16],
    basis: &'a [i8],
    steps: &'a [f32],
}

impl Decoder<'_> {
    /// Returns `[n][dim]` of components `[n][m]`.
    fn decode(&self, components: &[f32], with_mean: bool) -> Vec<f32> {
        let mut out = self.panels().product(Rows::all(components, self.m));
        if with_mean {
            for vector in out.chunks_exact_mut(self.dim) {
                vector.iter_mut().zip(self.mean).for_each(|(v, mean)| *v += mean.to_f32());
            }
        }
        out
    }

    fn panels(&self) -> Panels {
        Panels::new(self.m, self.dim, |c, i| f32::from(self.basis[c * self.dim + i]) * self.steps[c])
    }

    /// Returns the length of each basis vector.
    fn lengths(&self) -> Vec<f32> {
        let length = |(vector, step): (&[i8], &f32)| {
            vector.iter().map(|v| f32::from(*v).powi(2)).sum::<f32>().sqrt() * step
        };
        self.basis.chunks_exact(self.dim).zip(self.steps).map(length).collect()
    }
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

/// Rounds residuals (`[n][m]`, divided by their centroids' scales) to 8 bits. Returns them and their decoded form, in
/// readers' components. Steps follow the components' sizes, scales the largest of a centroid's members.
fn fine(
    residuals: &[f32],
    m: usize,
    centroid_starts: &[u32],
    residual_scales: &[f32],
    ranges: &[f32],
) -> (FineResiduals, Vec<f32>) {
    const MOST: f32 = 127.0;
    let of_centroid =
        |centroid: usize| centroid_starts[centroid] as usize * m..centroid_starts[centroid + 1] as usize * m;
    let mut squares = vec![0.0f64; m];
    for (centroid, scale) in residual_scales.iter().enumerate() {
        for (at, v) in residuals[of_centroid(centroid)].iter().enumerate() {
            squares[at % m] += f64::from(v * scale).powi(2);
        }
    }
    let n = (residuals.len() / m).max(1) as f64;
    // At least 1e-9: a component without residuals must not cause a division by zero.
    let sizes: Vec<f32> = squares.iter().map(|s| ((s / n).sqrt() as f32).max(1e-9)).collect();
    let steps: Vec<f32> = sizes.iter().zip(ranges).map(|(size, range)| size / range).collect();
    let (mut scales, mut values) =
        (Vec::with_capacity(residual_scales.len()), Vec::with_capacity(residuals.len()));
    let mut decoded = Vec::with_capacity(residuals.len());
    for (centroid, residual_scale) in residual_scales.iter().enumerate() {
        let in_sizes = |(at, v): (usize, &f32)| v * residual_scale / sizes[at % m];
        let members = || residuals[of_centroid(centroid)].iter().enumerate();
        let scale = members().map(in_sizes).fold(0.0f32, |most, v| most.max(v.abs())) / MOST;
        let factor = if scale > 0.0 { scale.recip() } else { 0.0 };
        for (at, v) in members() {
            let value = (in_sizes((at, v)) * factor).round().clamp(-MOST, MOST);
            values.push(value as i8);
            decoded.push(value * steps[at % m] * scale);
        }
        scales.push(scale);
    }
    (FineResiduals { steps, scales, values, errors: ScoreErrors::default() }, decoded)
}

/// Returns for each centroid the largest distance of a member from its decoded form, and the errors of the decoded
/// scores. `residuals`: components, in shard order, to add to the centroids.
fn compare(
    embeddings: Rows<'_>,
    order: &[u32],
    centroid_starts: &[u32],
    decoded_centroids: &[f32],
    residuals: Option<(&Decoder<'_>, &[f32])>,
    sample: &measure::Sample<'_>,
) -> (Vec<f32>, ScoreErrors) {
    let dim = embeddings.width;
    let added =
        residuals.map(|(decoder, components)| (decoder.panels(), decoder.lengths(), decoder.m, components));
    let chunks: Vec<(Vec<f32>, Vec<f32>)> = (0..order.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let places = chunk * CHUNK..order.len().min((chunk + 1) * CHUNK);
            let mut decoded = match &added {
                Some((panels, _, m, components)) => {
                    panels.product(Rows::all(&components[places.start * m..places.end * m], *m))
                }
                None => vec![0.0; places.len() * dim],
            };
            let mut centroid = centroid_starts.partition_point(|start| *start as usize <= places.start) - 1;
            let mut distances = Vec::with_capacity(places.len());
            let mut missed = Vec::new();
            for (place, decoded) in places.zip(decoded.chunks_exact_mut(dim)) {
                while centroid_starts[centroid + 1] as usize <= place {
                    centroid += 1;
                }
                let embedding = embeddings.get(order[place] as usize);
                let of_centroid = &decoded_centroids[centroid * dim..][..dim];
                for ((d, r), e) in decoded.iter_mut().zip(of_centroid).zip(embedding) {
                    *d = e - (r + *d);
                }
                // Bound of the products' rounding: the sizes of their terms times the number of additions.
                let rounding = added.as_ref().map_or(0.0, |(_, lengths, m, components)| {
                    let terms = components[place * m..][..*m].iter().zip(lengths).map(|(c, l)| c.abs() * l);
                    terms.sum::<f32>() * (*m as f32 + 4.0) * f32::EPSILON
                });
                let slack = 1.0 + dim as f32 * f32::EPSILON;
                let length = slag_math::dot(decoded, decoded).sqrt();
                distances.push((length * slack + rounding + 2.0 * f32::EPSILON).next_up());
                if sample.has(place) {
                    missed.extend_from_slice(decoded);
                }
            }
            (distances, missed)
        })
        .collect();
    let distances: Vec<f32> = chunks.iter().flat_map(|(distances, _)| distances).copied().collect();
    let missed: Vec<f32> = chunks.into_iter().flat_map(|(_, missed)| missed).collect();
    let radius = |members: &[u32]| {
        distances[members[0] as usize..members[1] as usize].iter().copied().fold(0.0, f32::max)
    };
    (centroid_starts.windows(2).map(radius).collect(), sample.errors(&missed))
}

#[cfg(test)]
mod tests;
