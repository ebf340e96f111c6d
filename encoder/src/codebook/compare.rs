//! What readers decode, its distances from the embeddings, and the errors of its scores.

use half::f16;
use rayon::prelude::*;
use slag_common::shard::ScoreErrors;
use slag_math::matrix::{Panels, Rows};

use super::cluster::Members;
use super::measure;

const CHUNK: usize = 1024;

#[derive(Clone, Copy)]
pub(super) struct Decoder<'a> {
    pub(super) dim: usize,
    pub(super) m: usize,
    pub(super) mean: &'a [f16],
    pub(super) basis: &'a [i8],
    pub(super) steps: &'a [f32],
}

impl Decoder<'_> {
    /// `[n][m]` to `[n][dim]`.
    pub(super) fn decode(&self, components: &[f32]) -> Vec<f32> {
        let mut out = self.panels().product(Rows::all(components, self.m));
        for vector in out.chunks_exact_mut(self.dim) {
            vector.iter_mut().zip(self.mean).for_each(|(v, mean)| *v += mean.to_f32());
        }
        out
    }

    pub(super) fn panels(&self) -> Panels {
        Panels::new(self.m, self.dim, |c, i| f32::from(self.basis[c * self.dim + i]) * self.steps[c])
    }

    pub(super) fn lengths(&self) -> Vec<f32> {
        let length = |(vector, step): (&[i8], &f32)| {
            vector.iter().map(|v| f32::from(*v).powi(2)).sum::<f32>().sqrt() * step
        };
        self.basis.chunks_exact(self.dim).zip(self.steps).map(length).collect()
    }
}

pub(super) struct Reference<'a> {
    pub(super) embeddings: Rows<'a>,
    pub(super) members: &'a Members,
    /// `[K][dim]`.
    pub(super) decoded_centroids: &'a [f32],
    pub(super) sample: &'a measure::Sample<'a>,
}

impl Reference<'_> {
    /// Returns each centroid's largest distance of a member from its decoded form, and the errors of decoded scores.
    /// `residuals`: components to add to the centroids, in the order of the members.
    pub(super) fn compare(&self, residuals: Option<(&Decoder<'_>, &[f32])>) -> (Vec<f32>, ScoreErrors) {
        let Self {
            embeddings,
            members: Members { order, starts: centroid_starts },
            decoded_centroids,
            sample,
        } = self;
        let dim = embeddings.width;
        let added = residuals
            .map(|(decoder, components)| (decoder.panels(), decoder.lengths(), decoder.m, components));
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
                let mut centroid =
                    centroid_starts.partition_point(|start| *start as usize <= places.start) - 1;
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
                    // Bound of rounding: sizes of the products' terms times the number of additions.
                    let rounding = added.as_ref().map_or(0.0, |(_, lengths, m, components)| {
                        let terms =
                            components[place * m..][..*m].iter().zip(lengths).map(|(c, l)| c.abs() * l);
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
}
