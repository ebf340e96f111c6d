//! Centroids for outliers: the hard bound of a score is the largest distance of a Gaussian from its centroid, and few are far.

use rayon::prelude::*;

use super::basis::Basis;
use super::cluster::Clusters;
use slag_math::dot;
use slag_math::matrix::{Panels, Rows};

/// One in so many Gaussians may get another centroid, the farthest from theirs.
const OUTLIER_STEP: usize = 8;

struct Outlier {
    at: usize,
    /// Squared length of the embedding less the mean.
    squared_length: f32,
    cluster: u32,
    squared_distance: f32,
}

/// Makes up to `n_more` centres out of the Gaussians farthest from theirs, one by one, each with the outliers that it is nearer
/// to (Gonzalez 1985: as many other centres beside the given ones would leave about half of the radius at least).
///
/// Ends when no distance is above `enough`. `points`: the components of the embeddings, in which the clusters were found. Distances are those of the embeddings.
pub(super) fn separate(
    embeddings: Rows<'_>,
    basis: &Basis,
    points: Rows<'_>,
    found: &mut Clusters,
    n_more: usize,
    enough: f32,
) {
    let (m, dim) = (basis.n_components, embeddings.width);
    let mean: Vec<f32> = basis.mean.iter().map(|v| v.to_f32()).collect();
    // With B the basis: |e - mean - B'c|^2 = |e - mean|^2 - 2 (B(e - mean)).c + |B'c|^2.
    let mut turned = Panels::new(dim, m, |i, c| basis.basis[c * dim + i]).product(embeddings);
    let of_mean: Vec<f32> = basis.basis.chunks_exact(dim).map(|vector| dot(vector, &mean)).collect();
    turned.par_chunks_exact_mut(m).for_each(|row| row.iter_mut().zip(&of_mean).for_each(|(v, o)| *v -= o));
    let decode = Panels::new(m, dim, |c, i| basis.basis[c * dim + i]);
    let squared_lengths = |centres: &[f32]| -> Vec<f32> {
        decode.product(Rows::all(centres, m)).chunks_exact(dim).map(|v| dot(v, v)).collect()
    };
    let distance = |at: usize, own: f32, centre: &[f32], length: f32| {
        own - 2.0 * dot(&turned[at * m..][..m], centre) + length
    };
    let lengths = squared_lengths(&found.centres);
    let mut outliers: Vec<Outlier> = (found.codes.par_iter().enumerate())
        .map(|(at, cluster)| {
            let own = embeddings.get(at).iter().zip(&mean).map(|(e, mean)| (e - mean).powi(2)).sum();
            let centre = &found.centres[*cluster as usize * m..][..m];
            let squared_distance = distance(at, own, centre, lengths[*cluster as usize]);
            Outlier { at, squared_length: own, cluster: *cluster, squared_distance }
        })
        .collect();
    outliers.sort_by(|a, b| b.squared_distance.total_cmp(&a.squared_distance).then(a.at.cmp(&b.at)));
    let rest = outliers.split_off(outliers.len().div_ceil(OUTLIER_STEP));
    let least = rest.first().map_or(0.0, |nearest| nearest.squared_distance).max(enough * enough);
    for _ in 0..n_more {
        let farther = |a: &'_ Outlier, b: &'_ Outlier| b.squared_distance > a.squared_distance;
        let Some(farthest) = outliers.iter().reduce(|a, b| if farther(a, b) { b } else { a }) else { return };
        let centre = points.get(farthest.at);
        let length = squared_lengths(centre)[0];
        let left = distance(farthest.at, farthest.squared_length, centre, length);
        // A centroid cannot reduce the part of an embedding that lies outside the basis.
        if farthest.squared_distance <= least || left >= farthest.squared_distance {
            break;
        }
        let cluster = (found.centres.len() / m) as u32;
        found.centres.extend_from_slice(centre);
        outliers.par_iter_mut().for_each(|outlier| {
            let squared_distance = distance(outlier.at, outlier.squared_length, centre, length);
            if squared_distance < outlier.squared_distance {
                (outlier.cluster, outlier.squared_distance) = (cluster, squared_distance);
            }
        });
    }
    outliers.iter().for_each(|outlier| found.codes[outlier.at] = outlier.cluster);
    found.drop_empty(m);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codebook::basis::{ScoreMetric, TextBank};
    use slag_math::random::Random;

    /// Oracle: farthest-point picks over all Gaussians in float64, each vector decoded in full. The basis keeps all components, so
    /// the last pick leaves less than the first.
    #[test]
    fn the_farthest_get_centroids_first() {
        let (n, dim, n_more) = (400, 6, 12);
        let mut random = Random::new(3);
        let vectors: Vec<f32> = (0..n)
            .flat_map(|at| {
                let spread = if at % 20 == 7 { 1.0 } else { 0.02 };
                let mut v = [1.0f32, 0.0, 0.0, 0.0, 0.0, 0.0].map(|c| c + spread * random.normal() as f32);
                let length = dot(&v, &v).sqrt();
                v.iter_mut().for_each(|c| *c /= length);
                v
            })
            .collect();
        let rows = Rows::all(&vectors, dim);
        let basis = Basis::fit(rows, &ScoreMetric::new(dim, &TextBank::default()), 0.0, dim);
        let m = basis.n_components;
        let points = basis.components(rows);
        let mut found = Clusters { codes: vec![0; n], centres: vec![0.0; m] };
        separate(rows, &basis, Rows::all(&points, m), &mut found, n_more, 0.0);

        let decode = |c: &[f32]| -> Vec<f64> {
            let of =
                |i: usize| (0..m).map(|k| f64::from(c[k]) * f64::from(basis.basis[k * dim + i])).sum::<f64>();
            (0..dim).map(|i| basis.mean[i].to_f64() + of(i)).collect()
        };
        let distance = |at: usize, centre: &[f64]| {
            let own = &vectors[at * dim..][..dim];
            own.iter().zip(centre).map(|(e, c)| (f64::from(*e) - c).powi(2)).sum::<f64>().sqrt()
        };
        let first = decode(&vec![0.0; m]);
        let mut expected: Vec<(u32, f64)> = (0..n).map(|at| (0, distance(at, &first))).collect();
        let before = expected.iter().map(|(_, d)| *d).fold(0.0, f64::max);
        for number in 1..=n_more as u32 {
            let farthest = (0..n).max_by(|a, b| expected[*a].1.total_cmp(&expected[*b].1)).expect("some");
            let centre = decode(&points[farthest * m..][..m]);
            for (at, (code, nearest)) in expected.iter_mut().enumerate() {
                let d = distance(at, &centre);
                if d < *nearest {
                    (*code, *nearest) = (number, d);
                }
            }
        }
        let after = expected.iter().map(|(_, d)| *d).fold(0.0, f64::max);
        assert!(after < before / 2.0, "{before} -> {after}");
        assert_eq!(found.centres.len(), (1 + n_more) * m);
        // Clusters are numbered by their first Gaussian.
        let mut numbers = std::collections::HashMap::new();
        for (at, (code, _)) in expected.iter().enumerate() {
            assert_eq!(*numbers.entry(*code).or_insert(found.codes[at]), found.codes[at], "Gaussian {at}");
        }
        assert_eq!(numbers.len(), 1 + n_more);
    }
}
