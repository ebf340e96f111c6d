//! Centroids for outliers: the hard bound of a score is the largest distance of a Gaussian from its centroid, and
//! few are far.

use rayon::prelude::*;

use super::basis::Basis;
use super::cluster::Clusters;
use slag_math::dot;
use slag_math::matrix::{Panels, Rows};

/// At most one in this many Gaussians, the farthest, may get another centroid.
const OUTLIER_STEP: usize = 8;

struct Outlier {
    at: usize,
    /// Of the embedding minus the mean.
    squared_length: f32,
    cluster: u32,
    squared_distance: f32,
}

/// Makes up to `n_more` centres out of the Gaussians farthest from theirs, one by one, each with the outliers that are
/// nearer to it (Gonzalez 1985: as many other additional centres would leave at least about half of the radius). Ends
/// when no distance exceeds `enough`. `points`: the embeddings' components, in which the clusters were found; distances
/// are those of the embeddings.
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
        // A centroid cannot reduce an embedding's part outside the basis.
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
mod tests;
