//! Superpoints are joined pair by pair, those with most affinity first: each join is a candidate for an object,
//! from a side of a cup to the whole table.
//!
//! The affinity of two sets is that of all their pairs that lie near each other, added up (average linkage, Sokal
//! and Michener 1958).

use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BinaryHeap};

use rayon::prelude::*;
use slag_common::Gaussians;
use slag_math::nearest::{self, Neighbours};

use super::sightings::{MaskSighting, Sightings, ViewSighting};
use crate::lift::superpoint::{NO_SUPERPOINT, Superpoints};
use crate::memory::{MemoryPlan, Phase};

/// A forest over superpoints.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tree {
    /// Superpoints are nodes 0 to `n_leaves - 1`.
    pub(super) n_leaves: usize,
    /// Parts of each further node; both have lower numbers.
    pub(super) parts: Vec<[u32; 2]>,
}

/// Affinity as bits, which have the order of positive numbers, then the two slots to join.
type Pair = (u64, Reverse<u32>, Reverse<u32>);

impl Tree {
    /// Joins `n` superpoints until no two have evidence. Equal affinities go by the lowest numbers; a join keeps the
    /// number of the part near more others, of equals the lower one.
    pub(super) fn new(n: usize, pairs: &[(u32, u32, Evidence)]) -> Self {
        let mut tree = Self { n_leaves: n, parts: Vec::new() };
        let mut neighbours: Vec<BTreeMap<u32, Evidence>> = vec![BTreeMap::new(); n];
        for (a, b, evidence) in pairs {
            neighbours[*a as usize].insert(*b, *evidence);
            neighbours[*b as usize].insert(*a, *evidence);
        }
        let bits = |evidence: &Evidence| evidence.affinity().to_bits();
        let pair = |a: u32, b: u32, evidence: &Evidence| -> Pair {
            (bits(evidence), Reverse(a.min(b)), Reverse(a.max(b)))
        };
        let mut waiting: BinaryHeap<Pair> =
            pairs.iter().map(|(a, b, evidence)| pair(*a, *b, evidence)).collect();
        let mut node_of: Vec<u32> = (0..n as u32).collect();
        while let Some((affinity, Reverse(a), Reverse(b))) = waiting.pop() {
            // Otherwise one of them has been joined, or has new evidence.
            if neighbours[a as usize].get(&b).map(bits) != Some(affinity) {
                continue;
            }
            let n_of = |slot: u32| neighbours[slot as usize].len();
            let (kept, gone) = if n_of(b) > n_of(a) { (b, a) } else { (a, b) };
            tree.parts.push([node_of[a as usize], node_of[b as usize]]);
            node_of[kept as usize] = (n + tree.parts.len() - 1) as u32;
            for (other, evidence) in std::mem::take(&mut neighbours[gone as usize]) {
                neighbours[other as usize].remove(&gone);
                if other == kept {
                    continue;
                }
                let sum = neighbours[kept as usize].entry(other).or_default();
                *sum += evidence;
                let sum = *sum;
                neighbours[other as usize].insert(kept, sum);
                waiting.push(pair(kept, other, &sum));
            }
        }
        tree
    }

    pub(super) fn len(&self) -> usize {
        self.n_leaves + self.parts.len()
    }

    /// `None` for a superpoint.
    pub(super) fn parts_of(&self, node: usize) -> Option<[usize; 2]> {
        let at = node.checked_sub(self.n_leaves)?;
        Some(self.parts[at].map(|part| part as usize))
    }

    /// Nodes that are part of no other, ascending.
    pub(super) fn roots(&self) -> impl Iterator<Item = usize> {
        let mut is_part = vec![false; self.len()];
        self.parts.iter().flatten().for_each(|part| is_part[*part as usize] = true);
        (0..self.len()).filter(move |node| !is_part[*node])
    }
}

/// A mask shows a superpoint if it has at least this share, in halves, of its Gaussians that the view sees.
const INSIDE_HALVES: u32 = 1;
/// Affinity without evidence, and the number of Gaussians that it counts for.
const PRIOR: f64 = 0.3;
const PRIOR_WEIGHT: f64 = 1.0;
/// A share of 1.
pub(super) const SHARE: u64 = 1 << 20;

/// What views say about two superpoints or sets of them; evidence adds up. Integers, so that order does not matter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Evidence {
    /// Sum over views: share of masks that show both, in units of [`SHARE`], times Gaussians.
    pub(super) together: u64,
    /// Sum over views: Gaussians of the smaller one.
    pub(super) n: u64,
}

impl Evidence {
    pub(super) fn affinity(&self) -> f64 {
        (self.together as f64 / SHARE as f64 + PRIOR * PRIOR_WEIGHT) / (self.n as f64 + PRIOR_WEIGHT)
    }
}

impl std::ops::AddAssign for Evidence {
    fn add_assign(&mut self, other: Self) {
        // Shares take 20 bits: thousands of views of billions of Gaussians are the limit.
        self.together = self.together.saturating_add(other.together);
        self.n = self.n.saturating_add(other.n);
    }
}

/// Leaves out pairs that no mask shows together.
pub(super) fn evidence_of_pairs(sightings: &Sightings, pairs: &[(u32, u32)]) -> Vec<(u32, u32, Evidence)> {
    let of_pair = |(a, b): &(u32, u32)| (*a, *b, of_pair(sightings, *a as usize, *b as usize));
    pairs.par_iter().map(of_pair).filter(|(_, _, evidence)| evidence.together > 0).collect()
}

fn of_pair(sightings: &Sightings, a: usize, b: usize) -> Evidence {
    let mut evidence = Evidence::default();
    let (mut of_a, mut of_b) = (sightings.of(a).peekable(), sightings.of(b).peekable());
    while let (Some(a), Some(b)) = (of_a.peek(), of_b.peek()) {
        match a.view.cmp(&b.view) {
            Ordering::Less => drop(of_a.next()),
            Ordering::Greater => drop(of_b.next()),
            Ordering::Equal => {
                let (n_both, n_either) = shared(a, b);
                // Without a mask of either, a view is no evidence.
                if let Some(share) = (n_both * SHARE).checked_div(n_either) {
                    let n = u64::from(a.n.min(b.n));
                    evidence += Evidence { together: n * share, n };
                }
                of_a.next();
                of_b.next();
            }
        }
    }
    evidence
}

/// Number of masks that show both superpoints, and of those that show either; zeros if a view sees only one.
fn shared(a: &ViewSighting<'_>, b: &ViewSighting<'_>) -> (u64, u64) {
    if a.n == 0 || b.n == 0 {
        return (0, 0);
    }
    let inside = |of_view: &ViewSighting<'_>| {
        let n = of_view.n;
        move |of_mask: &&MaskSighting| of_mask.n > 0 && of_mask.n * 2 >= n * INSIDE_HALVES
    };
    let n_a = a.masks.iter().filter(inside(a)).count();
    let n_b = b.masks.iter().filter(inside(b)).count();
    let is_of_b = |of_a: &&MaskSighting| {
        let at = b.masks.binary_search_by_key(&of_a.mask, |of_b| of_b.mask);
        at.is_ok_and(|at| inside(b)(&&b.masks[at]))
    };
    let n_both = a.masks.iter().filter(inside(a)).filter(is_of_b).count();
    (n_both as u64, (n_a + n_b - n_both) as u64)
}

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
