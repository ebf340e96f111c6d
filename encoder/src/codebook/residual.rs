//! The residual code: a residual, an embedding minus its centroid, becomes one of 16 codewords in each subspace of
//! components.
//!
//! Components are the eigenvectors of the residuals, so subspaces can be coded one by one (optimised product
//! quantisation: Ge, He, Ke and Sun 2013). Codes have four bits, which a byte shuffle can look up.

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{BLOCK, CODEWORDS, ScoreErrors};
use slag_math::eigen::eigen_symmetric;
use slag_math::matrix::Rows;

use super::cluster::{Members, clusters, mean, nearest, squared_distance};

const TRAINING_SAMPLE: usize = 6144;
/// Most components of a subspace: 16 codewords describe more too coarsely.
const MAX_SUBSPACE_COMPONENTS: usize = 8;
const SUBSPACES_STEP: usize = 4;

pub struct ResidualCode {
    /// `[G + 1]`.
    pub subspace_starts: Vec<u32>,
    /// By subspace, `[16][components of the subspace]`.
    pub codewords: Vec<f16>,
}

/// Rotation (rows `[m][m]`) to the residuals' eigenvectors, and their eigenvalues.
pub fn rotation(residuals: Rows<'_>) -> (Vec<f32>, Vec<f64>) {
    let m = residuals.width;
    let stride = residuals.len().div_ceil(TRAINING_SAMPLE).max(1);
    let sample: Vec<u32> = (0..residuals.len() as u32).step_by(stride).collect();
    let moments = sample
        .par_chunks(512)
        .map(|chunk| {
            let mut sums = vec![0.0f64; m * m];
            for row in chunk {
                let residual = residuals.get(*row as usize);
                for (i, a) in residual.iter().enumerate() {
                    sums[i * m..][..=i].iter_mut().zip(residual).for_each(|(s, b)| *s += f64::from(a * b));
                }
            }
            sums
        })
        // Collected in order, so that sums do not depend on threads.
        .collect::<Vec<_>>();
    let mut total = vec![0.0; m * m];
    moments.iter().for_each(|sums| total.iter_mut().zip(sums).for_each(|(t, s)| *t += s));
    for i in 0..m {
        for j in 0..i {
            total[j * m + i] = total[i * m + j];
        }
    }
    total.iter_mut().for_each(|t| *t /= sample.len().max(1) as f64);
    let (values, vectors) = eigen_symmetric(total, m);
    (vectors.into_iter().map(|v| v as f32).collect(), values)
}

/// Assigns components to subspaces with the least total loss. Returns the components by subspace (those in none last),
/// and the starts of the subspaces.
pub(crate) fn subspaces(variances: &[f64], n_subspaces: usize) -> (Vec<usize>, Vec<u32>) {
    let log = |c: usize| log_variance(variances[c]);
    let mut members: Vec<Vec<usize>> = (0..n_subspaces).map(|c| vec![c]).collect();
    let mut log_products: Vec<f64> = (0..n_subspaces).map(log).collect();
    let mut outside = Vec::new();
    for (c, variance) in variances.iter().enumerate().skip(n_subspaces) {
        let rise = |g: usize| {
            let d = members[g].len();
            loss(d + 1, log_products[g] + log(c)) - loss(d, log_products[g])
        };
        let best = (0..n_subspaces)
            .filter(|g| members[*g].len() < MAX_SUBSPACE_COMPONENTS)
            .min_by(|a, b| rise(*a).total_cmp(&rise(*b)));
        match best.filter(|g| rise(*g) < *variance) {
            Some(g) => {
                log_products[g] += log(c);
                members[g].push(c);
            }
            None => outside.push(c),
        }
    }
    let mut starts = vec![0u32];
    members.iter().for_each(|subspace| starts.push(starts[starts.len() - 1] + subspace.len() as u32));
    (members.into_iter().flatten().chain(outside).collect(), starts)
}

impl ResidualCode {
    /// Trains the codewords of subspaces of consecutive components.
    pub fn train(residuals: Rows<'_>, subspace_starts: Vec<u32>) -> Self {
        let stride = residuals.len().div_ceil(TRAINING_SAMPLE).max(1);
        let sample: Vec<usize> = (0..residuals.len()).step_by(stride).collect();
        let codewords: Vec<Vec<f16>> = subspace_starts
            .par_windows(2)
            .map(|subspace| {
                let (from, to) = (subspace[0] as usize, subspace[1] as usize);
                let points: Vec<f32> =
                    sample.iter().flat_map(|row| &residuals.get(*row)[from..to]).copied().collect();
                let mut codewords = trained(Rows::all(&points, to - from), CODEWORDS);
                // With fewer distinct residuals than codewords, the rest is never used.
                codewords.resize(CODEWORDS * (to - from), 0.0);
                codewords.into_iter().map(f16::from_f32).collect()
            })
            .collect();
        Self { subspace_starts, codewords: codewords.concat() }
    }

    /// Divides the components of the codewords by their ranges, as they are stored.
    pub(super) fn divided(mut self, ranges: &[f32]) -> Self {
        for starts in self.subspace_starts.windows(2) {
            let (from, to) = (starts[0] as usize, starts[1] as usize);
            let codewords = &mut self.codewords[CODEWORDS * from..CODEWORDS * to];
            for (at, codeword) in codewords.iter_mut().enumerate() {
                *codeword = f16::from_f32(codeword.to_f32() / ranges[from + at % (to - from)]);
            }
        }
        self
    }

    pub fn n_subspaces(&self) -> usize {
        self.subspace_starts.len() - 1
    }

    pub fn n_components(&self) -> usize {
        self.subspace_starts[self.n_subspaces()] as usize
    }

    /// Codes `[ceil(n / 32)][G / 2][32]` of residuals, and their decoded form `[n][components covered]`.
    pub fn encode(&self, residuals: Rows<'_>) -> (Vec<u8>, Vec<f32>) {
        let (n_subspaces, covered) = (self.n_subspaces(), self.n_components());
        let codewords: Vec<f32> = self.codewords.iter().map(|w| w.to_f32()).collect();
        let mut codes = vec![0u8; residuals.len().div_ceil(BLOCK) * BLOCK * n_subspaces / 2];
        let mut decoded = vec![0.0; residuals.len() * covered];
        codes
            .par_chunks_mut(BLOCK * n_subspaces / 2)
            .zip(decoded.par_chunks_mut(BLOCK * covered))
            .enumerate()
            .for_each(|(block, (codes, decoded))| {
                for (place, decoded) in decoded.chunks_exact_mut(covered).enumerate() {
                    let residual = residuals.get(block * BLOCK + place);
                    for subspace in 0..n_subspaces {
                        let of_subspace = self.subspace_starts[subspace] as usize
                            ..self.subspace_starts[subspace + 1] as usize;
                        let codewords =
                            &codewords[CODEWORDS * of_subspace.start..CODEWORDS * of_subspace.end];
                        let code = nearest_codeword(&residual[of_subspace.clone()], codewords);
                        codes[subspace / 2 * BLOCK + place] |= (code as u8) << (4 * (subspace % 2));
                        let len = of_subspace.len();
                        decoded[of_subspace].copy_from_slice(&codewords[code * len..][..len]);
                    }
                }
            });
        (codes, decoded)
    }
}

fn nearest_codeword(residual: &[f32], codewords: &[f32]) -> usize {
    let mut best = (f32::INFINITY, 0);
    for (code, codeword) in codewords.chunks_exact(residual.len()).enumerate() {
        let distance: f32 = residual.iter().zip(codeword).map(|(a, b)| (a - b) * (a - b)).sum();
        if distance < best.0 {
            best = (distance, code);
        }
    }
    best.1
}

/// K-means; `n_codewords` at most.
pub fn trained(points: Rows<'_>, n_codewords: usize) -> Vec<f32> {
    /// Rounds after those of the clusters: more gain less than a hundredth.
    const ROUNDS: usize = 4;
    let mut codewords = clusters(points, 0.0, n_codewords).centres;
    let n_codewords = codewords.len() / points.width;
    for _ in 0..ROUNDS {
        let members = Members::new(&nearest(points, &codewords), n_codewords);
        for (number, codeword) in codewords.chunks_exact_mut(points.width).enumerate() {
            let places = members.places(number);
            if !places.is_empty() {
                codeword.copy_from_slice(&mean(points, &members.order[places]));
            }
        }
    }
    codewords
}

/// Returns the shortest code that leaves at most `max_rms` of the residuals, and its order of components; `None` if
/// none is needed, or if `max_subspaces` is below 2. `scales`: the divisor of each residual.
pub fn plan(
    residuals: Rows<'_>,
    scales: &[f32],
    variances: &[f64],
    max_rms: f32,
    max_subspaces: usize,
) -> Option<(Vec<usize>, ResidualCode)> {
    let m = residuals.width;
    let stride = residuals.len().div_ceil(TRAINING_SAMPLE).max(1);
    let sample: Vec<usize> = (0..residuals.len()).step_by(stride).collect();
    let mean_square = |error: &mut dyn FnMut(usize) -> f64| {
        let total: f64 =
            sample.iter().enumerate().map(|(at, row)| error(at) * f64::from(scales[*row]).powi(2)).sum();
        total / sample.len().max(1) as f64
    };
    let target = f64::from(max_rms).powi(2);
    let norm = |row: usize| residuals.get(row).iter().map(|v| f64::from(v * v)).sum::<f64>();
    if mean_square(&mut |at| norm(sample[at])) <= target {
        return None;
    }
    let max_subspaces = max_subspaces.min(m) / 2 * 2;
    if max_subspaces == 0 {
        return None;
    }
    let train = |n_subspaces: usize| {
        let (order, starts) = subspaces(variances, n_subspaces);
        let points: Vec<f32> =
            sample.iter().flat_map(|row| order.iter().map(|c| residuals.get(*row)[*c])).collect();
        let points = Rows::all(&points, m);
        let code = ResidualCode::train(points, starts);
        let (_, decoded) = code.encode(points);
        let covered = code.n_components();
        let error = mean_square(&mut |at| {
            let (inside, outside) = points.get(at).split_at(covered);
            let inside = squared_distance(inside, &decoded[at * covered..][..covered]);
            f64::from(inside) + outside.iter().map(|v| f64::from(v * v)).sum::<f64>()
        });
        (order, code, error)
    };
    // The error of a short code shows how far the residuals are from the estimate's Gaussian ones; only the code of
    // the length that follows is trained.
    let few = (2 * SUBSPACES_STEP).min(max_subspaces);
    let (order, code, error) = train(few);
    if error <= target || few == max_subspaces {
        return Some((order, code));
    }
    let factor = error / estimated_loss(variances, few);
    let steps = (few..max_subspaces).step_by(SUBSPACES_STEP).skip(1);
    let enough = steps.into_iter().find(|n| factor * estimated_loss(variances, *n) <= target);
    let (order, code, _) = train(enough.unwrap_or(max_subspaces));
    Some((order, code))
}

/// Mean squared error that a code of this many subspaces would leave of Gaussian residuals.
fn estimated_loss(variances: &[f64], n_subspaces: usize) -> f64 {
    let (order, starts) = subspaces(variances, n_subspaces);
    let of_subspace = |subspace: &[u32]| {
        let members = &order[subspace[0] as usize..subspace[1] as usize];
        loss(members.len(), members.iter().map(|c| log_variance(variances[*c])).sum())
    };
    let outside = &order[starts[n_subspaces] as usize..];
    starts.windows(2).map(of_subspace).sum::<f64>() + outside.iter().map(|c| variances[*c]).sum::<f64>()
}

/// Loss of `d` Gaussian components in four bits, from their sum of log variances (rate distortion at equal loss).
fn loss(d: usize, log_product: f64) -> f64 {
    d as f64 * ((log_product - 8.0 * std::f64::consts::LN_2) / d as f64).exp()
}

fn log_variance(variance: f64) -> f64 {
    variance.max(1e-30).ln()
}

pub struct FineResiduals {
    /// `[m]`.
    pub steps: Vec<f32>,
    /// `[K]`.
    pub scales: Vec<f32>,
    /// `[n][m]`.
    pub values: Vec<i8>,
    pub errors: ScoreErrors,
}

/// Rounds residuals (`[n][m]`, divided by their centroids' scales) to 8 bits; returns them and their decoded form in
/// readers' components. Steps follow the components' sizes, scales the largest of a centroid's members.
pub(super) fn round(
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
    // At least 1e-9, against division by zero where a component has no residuals.
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
