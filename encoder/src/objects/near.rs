//! Superpoints that lie near each other: only these can be of one object.

use rayon::prelude::*;
use slag_common::Gaussians;
use slag_math::nearest::{self, Neighbours};

use crate::lift::superpoint::{NO_SUPERPOINT, Superpoints};
use crate::memory::{MemoryPlan, Phase};

const MAX_SAMPLES: usize = 4;
/// Least Gaussians per sample, for small superpoints.
const GAUSSIANS_PER_SAMPLE: usize = 8;
/// Nearest samples of a sample: with its own superpoint's, those of a dozen.
const N_NEIGHBOURS: usize = 48;

pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    let per_sample = size_of::<(u32, u32)>()
        + size_of::<[f64; 3]>()
        + nearest::working_bytes_per_point(N_NEIGHBOURS)
        + N_NEIGHBOURS / 2 * size_of::<(u32, u32)>();
    let len_bytes = (n_gaussians / GAUSSIANS_PER_SAMPLE * per_sample) as u64;
    memory.reserve(Phase::Objects, "superpoints near each other", len_bytes);
}

/// Pairs of superpoints with a sampled Gaussian of one among the nearest neighbours of a sample of the other. The lower
/// number comes first; pairs are ascending.
pub(super) fn pairs(scene: &Gaussians, superpoints: &Superpoints) -> Vec<(u32, u32)> {
    let samples = samples(superpoints);
    let points: Vec<[f64; 3]> =
        samples.par_iter().map(|(_, gaussian)| scene.means_in_world[*gaussian as usize].to_array()).collect();
    let neighbours = Neighbours::new(&points, N_NEIGHBOURS);
    drop(points);
    let near = |(at, (own, _)): (usize, &(u32, u32))| {
        let others = neighbours.of(at as u32).iter().map(|other| samples[*other as usize].0);
        let mut others: Vec<u32> = others.filter(|other| other != own).collect();
        others.sort_unstable();
        others.dedup();
        others.into_iter().map(|other| (*own.min(&other), *own.max(&other))).collect::<Vec<_>>()
    };
    let mut pairs: Vec<(u32, u32)> = samples.par_iter().enumerate().flat_map_iter(near).collect();
    pairs.par_sort_unstable();
    pairs.dedup();
    pairs
}

/// Up to [`MAX_SAMPLES`] Gaussians of each superpoint, evenly spread in the scene's order: (superpoint, Gaussian),
/// ascending.
fn samples(superpoints: &Superpoints) -> Vec<(u32, u32)> {
    let sizes = superpoints.sizes();
    let most = superpoints.of_gaussian.len() / GAUSSIANS_PER_SAMPLE / superpoints.n.max(1);
    let most = most.clamp(1, MAX_SAMPLES);
    let mut n_before = vec![0usize; superpoints.n];
    let is_sample = |(_, superpoint): &(u32, &u32)| {
        if **superpoint == NO_SUPERPOINT {
            return false;
        }
        let (n, before) = (sizes[**superpoint as usize] as usize, &mut n_before[**superpoint as usize]);
        let n_samples = n.min(most);
        // The j-th sample comes after j * n / n_samples others.
        let is_sample = (0..n_samples).any(|j| j * n / n_samples == *before);
        *before += 1;
        is_sample
    };
    let gaussians = (0u32..).zip(&superpoints.of_gaussian).filter(is_sample);
    let mut samples: Vec<(u32, u32)> =
        gaussians.map(|(gaussian, superpoint)| (*superpoint, gaussian)).collect();
    samples.par_sort_unstable();
    samples
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// By hand: 40 superpoints of 10 Gaussians along a line; the 24 nearest samples on either side are those of six.
    #[test]
    fn pairs_are_near_and_samples_are_even() {
        let n = 400u32;
        let scene = Gaussians {
            means_in_world: (0..n).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect(),
            ..Gaussians::default()
        };
        let mut of_gaussian: Vec<u32> = (0..n).map(|i| i / 10).collect();
        of_gaussian[0] = NO_SUPERPOINT;
        let few = samples(&Superpoints { of_gaussian: of_gaussian.clone(), n: 40 });
        assert_eq!((few.len(), &few[..3]), (40, &[(0, 1), (1, 10), (2, 20)][..]));
        // Gaussians without a superpoint: now there are enough for four samples each.
        of_gaussian.resize(1300, NO_SUPERPOINT);
        let superpoints = Superpoints { of_gaussian, n: 40 };
        let found = samples(&superpoints);
        assert_eq!(found[..8], [(0, 1), (0, 3), (0, 5), (0, 7), (1, 10), (1, 12), (1, 15), (1, 17)]);
        assert_eq!(found.len(), 160);
        let pairs = pairs(&scene, &superpoints);
        let of_twenty: Vec<u32> =
            pairs.iter().filter(|(a, b)| *a == 20 || *b == 20).map(|(a, b)| a + b - 20).collect();
        assert_eq!(of_twenty, [14, 15, 16, 17, 18, 19, 21, 22, 23, 24, 25, 26]);
        assert!(pairs.iter().all(|(a, b)| a < b) && pairs.is_sorted());
    }
}
