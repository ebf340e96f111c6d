//! What one row leaves of its members: a word of 16 for each of some groups of components.
//!
//! Components are the eigenvectors of the residuals, so that groups can be coded one by one (optimised
//! product quantisation: Ge, He, Ke and Sun 2013; a code of four bits: what a byte shuffle looks up).

use half::f16;
use rayon::prelude::*;
use slag_common::shard::{BLOCK, WORDS};

use super::cluster::{clusters, nearest, squared_distance};
use super::matrix::{Rows, eigen_symmetric};

/// Residuals that words are trained on.
const TRAINING_SAMPLE: usize = 6144;
/// Most components of a group: with more, 16 words say little of each.
const MAX_GROUP: usize = 8;
/// Numbers of groups are multiples of this.
const GROUPS_STEP: usize = 4;

/// A residual code.
pub struct ResidualCode {
    /// `[G + 1]`.
    pub group_starts: Vec<u32>,
    /// Group by group `[16][components of the group]`.
    pub words: Vec<f16>,
}

/// Returns the rotation (rows `[m][m]`) to the residuals' eigenvectors, and their eigenvalues.
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
        // Collected in order: the sum is the same for any number of threads.
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

/// Puts components into groups so that all together lose least, and returns the components in the order of
/// their groups (those in none last) and where the groups start.
pub fn groups(variances: &[f64], n_groups: usize) -> (Vec<usize>, Vec<u32>) {
    let log = |c: usize| log_variance(variances[c]);
    let mut members: Vec<Vec<usize>> = (0..n_groups).map(|c| vec![c]).collect();
    let mut log_products: Vec<f64> = (0..n_groups).map(log).collect();
    let mut outside = Vec::new();
    for (c, variance) in variances.iter().enumerate().skip(n_groups) {
        let rise = |g: usize| {
            let d = members[g].len();
            loss(d + 1, log_products[g] + log(c)) - loss(d, log_products[g])
        };
        let best = (0..n_groups)
            .filter(|g| members[*g].len() < MAX_GROUP)
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
    members.iter().for_each(|group| starts.push(starts[starts.len() - 1] + group.len() as u32));
    (members.into_iter().flatten().chain(outside).collect(), starts)
}

impl ResidualCode {
    /// Trains the words of groups of consecutive components.
    pub fn train(residuals: Rows<'_>, group_starts: Vec<u32>) -> Self {
        let stride = residuals.len().div_ceil(TRAINING_SAMPLE).max(1);
        let sample: Vec<usize> = (0..residuals.len()).step_by(stride).collect();
        let words: Vec<Vec<f16>> = group_starts
            .par_windows(2)
            .map(|group| {
                let (from, to) = (group[0] as usize, group[1] as usize);
                let points: Vec<f32> =
                    sample.iter().flat_map(|row| &residuals.get(*row)[from..to]).copied().collect();
                let mut words = trained(Rows::all(&points, to - from), WORDS);
                // Fewer distinct residuals than words: the rest is never named.
                words.resize(WORDS * (to - from), 0.0);
                words.into_iter().map(f16::from_f32).collect()
            })
            .collect();
        Self { group_starts, words: words.concat() }
    }

    /// Returns the number of groups.
    pub fn n_groups(&self) -> usize {
        self.group_starts.len() - 1
    }

    /// Returns the components that words cover.
    pub fn n_components(&self) -> usize {
        self.group_starts[self.n_groups()] as usize
    }

    /// Returns the codes of residuals, `[ceil(n / 32)][G / 2][32]`, and what they decode to,
    /// `[n][components covered]`.
    pub fn encode(&self, residuals: Rows<'_>) -> (Vec<u8>, Vec<f32>) {
        let (n_groups, covered) = (self.n_groups(), self.n_components());
        let words: Vec<f32> = self.words.iter().map(|w| w.to_f32()).collect();
        let mut codes = vec![0u8; residuals.len().div_ceil(BLOCK) * BLOCK * n_groups / 2];
        let mut decoded = vec![0.0; residuals.len() * covered];
        codes
            .par_chunks_mut(BLOCK * n_groups / 2)
            .zip(decoded.par_chunks_mut(BLOCK * covered))
            .enumerate()
            .for_each(|(block, (codes, decoded))| {
                for (place, decoded) in decoded.chunks_exact_mut(covered).enumerate() {
                    let residual = residuals.get(block * BLOCK + place);
                    for group in 0..n_groups {
                        let of_group =
                            self.group_starts[group] as usize..self.group_starts[group + 1] as usize;
                        let words = &words[WORDS * of_group.start..WORDS * of_group.end];
                        let code = nearest_word(&residual[of_group.clone()], words);
                        codes[group / 2 * BLOCK + place] |= (code as u8) << (4 * (group % 2));
                        let len = of_group.len();
                        decoded[of_group].copy_from_slice(&words[code * len..][..len]);
                    }
                }
            });
        (codes, decoded)
    }
}

fn nearest_word(residual: &[f32], words: &[f32]) -> usize {
    let mut best = (f32::INFINITY, 0);
    for (code, word) in words.chunks_exact(residual.len()).enumerate() {
        let distance: f32 = residual.iter().zip(word).map(|(a, b)| (a - b) * (a - b)).sum();
        if distance < best.0 {
            best = (distance, code);
        }
    }
    best.1
}

/// Returns the means of k-means, `n_words` at most.
pub fn trained(points: Rows<'_>, n_words: usize) -> Vec<f32> {
    /// Rounds after those of the clusters: the gain of more is below a hundredth.
    const ROUNDS: usize = 4;
    let mut words = clusters(points, 0.0, n_words).centres;
    for _ in 0..ROUNDS {
        let codes = nearest(points, &words);
        let mut sums = vec![0.0f64; words.len()];
        let mut counts = vec![0.0f64; words.len() / points.width];
        for (row, code) in codes.iter().enumerate() {
            counts[*code as usize] += 1.0;
            let sum = &mut sums[*code as usize * points.width..][..points.width];
            sum.iter_mut().zip(points.get(row)).for_each(|(s, v)| *s += f64::from(*v));
        }
        for (at, word) in words.iter_mut().enumerate() {
            let count = counts[at / points.width];
            if count > 0.0 {
                *word = (sums[at] / count) as f32;
            }
        }
    }
    words
}

/// Returns the smallest number of groups whose code leaves at most `max_rms` of the residuals, with the code
/// and the order of components that it needs; `None` where none is needed. `scales`: what each residual was
/// divided by.
pub fn plan(
    residuals: Rows<'_>,
    scales: &[f32],
    variances: &[f64],
    max_rms: f32,
    max_groups: usize,
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
    let max_groups = max_groups.min(m) / 2 * 2;
    let train = |n_groups: usize| {
        let (order, starts) = groups(variances, n_groups);
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
    // A short code tells how far the residuals are from what the estimate takes them for; the length that is
    // needed follows from it, and only that one is trained.
    let few = (2 * GROUPS_STEP).min(max_groups);
    let (order, code, error) = train(few);
    if error <= target || few == max_groups {
        return Some((order, code));
    }
    let factor = error / estimated_loss(variances, few);
    let steps = (few..max_groups).step_by(GROUPS_STEP).skip(1);
    let enough = steps.into_iter().find(|n| factor * estimated_loss(variances, *n) <= target);
    let (order, code, _) = train(enough.unwrap_or(max_groups));
    Some((order, code))
}

/// Returns what a code of so many groups leaves of the residuals, as mean square, if they were Gaussian.
fn estimated_loss(variances: &[f64], n_groups: usize) -> f64 {
    let (order, starts) = groups(variances, n_groups);
    let of_group = |group: &[u32]| {
        let members = &order[group[0] as usize..group[1] as usize];
        loss(members.len(), members.iter().map(|c| log_variance(variances[*c])).sum())
    };
    let outside = &order[starts[n_groups] as usize..];
    starts.windows(2).map(of_group).sum::<f64>() + outside.iter().map(|c| variances[*c]).sum::<f64>()
}

/// What four bits leave of `d` components, given the sum of the logarithms of their variances (rate and
/// distortion of Gaussian ones at equal loss).
fn loss(d: usize, log_product: f64) -> f64 {
    d as f64 * ((log_product - 8.0 * std::f64::consts::LN_2) / d as f64).exp()
}

fn log_variance(variance: f64) -> f64 {
    variance.max(1e-30).ln()
}
