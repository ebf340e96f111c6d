//! Clusters the masks that show the same thing by view consensus, after MaskClustering (Yan et al., CVPR 2024), but over
//! contributions instead of a point cloud.
//!
//! A mask is the set of sampled Gaussians that it shows. Two masks are compared by intersection over union, among the Gaussians
//! that the views of both see. A view's *agreement* with a mask is the best such value of its own masks. A mask's consensus is
//! the mean agreement of the views that see enough of it. A mask without consensus covers several things, or a part that no
//! other view separates: it is set aside.
//!
//! MaskClustering merges two masks if a mask of most views contains both. The segmenters here return wholes and parts side
//! by side, and the coarsest mask contains everything: with automatic masks of the labelled house, that rule made one
//! object of 84 % of the Gaussians. So masks are not chained. The mask with most agreement gathers those like it, their
//! majority is the object's shape, and the masks like that shape belong to the object.
//!
//! Counts are integers and every order is fixed: the result does not depend on threads.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::object::NONE;

/// Share of a mask that a view must see to judge it, in tenths (3, as in MaskClustering).
const OBSERVED_TENTHS: usize = 3;
/// The same for an object, of which a view sees one side at best.
const OBJECT_OBSERVED_TENTHS: usize = 1;
/// Masks with this intersection over union show the same thing: a majority of their union.
const SAME_IOU: f64 = 0.5;
/// Masks below this consensus are set aside: again a majority.
const MIN_CONSENSUS: f64 = 0.5;
/// Smallest mask, sampled Gaussians: shares of fewer mean nothing.
const MIN_SAMPLES: usize = 3;
/// Fewest views of an object: one cannot agree with others.
const MIN_VIEWS: usize = 2;

/// The region of each sampled Gaussian in each view that sees it: the one with most of its weight.
#[derive(Clone, Debug, PartialEq)]
pub struct Sightings {
    /// `[n + 1]`: where each sampled Gaussian's sightings start.
    pub starts: Vec<usize>,
    /// The view of each sighting, ascending for a Gaussian.
    pub views: Vec<u32>,
    /// Its region, numbered over all views.
    pub regions: Vec<u32>,
}

impl Sightings {
    /// Returns the number of sampled Gaussians.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns (view, region) of each sighting of a sampled Gaussian.
    fn of(&self, sample: u32) -> impl Iterator<Item = (usize, u32)> + '_ {
        let range = self.starts[sample as usize]..self.starts[sample as usize + 1];
        self.views[range.clone()].iter().map(|view| *view as usize).zip(self.regions[range].iter().copied())
    }
}

/// The masks of a scene.
pub struct Masks<'a> {
    /// The masks of each region.
    pub of_region: &'a (dyn Fn(u32) -> &'a [u32] + Sync),
    /// The view of each mask, ascending.
    pub view_of_mask: &'a [u32],
    /// Views.
    pub n_views: usize,
}

/// The clusters of a scene's masks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MaskClusters {
    /// `[n_masks]`: the cluster of each mask, or [`NONE`].
    pub cluster_of_mask: Vec<u32>,
    /// The consensus of each cluster, 0..1: the mean agreement of the views that see its shape.
    pub consensus: Vec<f64>,
    /// Masks without consensus.
    pub n_set_aside: usize,
}

/// The views' judgement of a mask.
#[derive(Default)]
struct Judged {
    /// Sum of the views' agreement, including its own view's 1.
    agreement: f64,
    /// Mean agreement of the other views.
    consensus: f64,
}

/// Counts by mask and by view, cleared after each use.
struct Counts {
    of_mask: Vec<u32>,
    of_view: Vec<u32>,
    /// Masks with a count.
    masks: Vec<u32>,
}

struct Consensus<'a> {
    sightings: &'a Sightings,
    masks: &'a Masks<'a>,
    /// `[n_masks + 1]`, and the sampled Gaussians of each mask.
    starts: Vec<usize>,
    samples: Vec<u32>,
    /// For each mask, the views that see some of its Gaussians, ascending, and how many.
    seen: Vec<Vec<(u32, u32)>>,
}

/// Clusters the masks of a scene. Returns `None` if cancelled.
pub fn cluster_masks<'a>(
    sightings: &'a Sightings,
    masks: &'a Masks<'a>,
    cancel: &AtomicBool,
) -> Option<MaskClusters> {
    let is_cancelled = || cancel.load(Ordering::Relaxed);
    let consensus = Consensus::new(sightings, masks);
    let n_masks = masks.view_of_mask.len();
    let judged: Vec<Judged> = (0..n_masks)
        .into_par_iter()
        .map_init(
            || Counts::new(masks),
            |counts, mask| match is_cancelled() {
                true => Judged::default(),
                false => consensus.judge(mask as u32, counts).0,
            },
        )
        .collect();
    let clusters = consensus.gather(&judged, &is_cancelled);
    // A cancelled run leaves masks unjudged: its clusters mean nothing.
    (!is_cancelled()).then_some(clusters)
}

impl Counts {
    fn new(masks: &Masks<'_>) -> Self {
        let (of_mask, of_view) = (vec![0; masks.view_of_mask.len()], vec![0; masks.n_views]);
        Self { of_mask, of_view, masks: Vec::new() }
    }

    /// Counts the sightings of some sampled Gaussians, by mask and by view.
    fn add(&mut self, samples: &[u32], sightings: &Sightings, masks: &Masks<'_>) {
        for (view, region) in samples.iter().flat_map(|sample| sightings.of(*sample)) {
            self.of_view[view] += 1;
            for mask in (masks.of_region)(region) {
                let count = &mut self.of_mask[*mask as usize];
                if *count == 0 {
                    self.masks.push(*mask);
                }
                *count += 1;
            }
        }
        self.masks.sort_unstable();
    }

    fn clear(&mut self) {
        self.masks.drain(..).for_each(|mask| self.of_mask[mask as usize] = 0);
        self.of_view.fill(0);
    }
}

impl<'a> Consensus<'a> {
    fn new(sightings: &'a Sightings, masks: &'a Masks<'a>) -> Self {
        let n_masks = masks.view_of_mask.len();
        let mut starts = vec![0usize; n_masks + 1];
        for region in &sightings.regions {
            (masks.of_region)(*region).iter().for_each(|mask| starts[*mask as usize + 1] += 1);
        }
        for mask in 0..n_masks {
            starts[mask + 1] += starts[mask];
        }
        let mut next = starts.clone();
        let mut samples = vec![0; starts[n_masks]];
        for sample in 0..sightings.len() as u32 {
            for mask in sightings.of(sample).flat_map(|(_, region)| (masks.of_region)(region)) {
                samples[next[*mask as usize]] = sample;
                next[*mask as usize] += 1;
            }
        }
        let seen_of = |n_of_view: &mut Vec<u32>, mask: usize| {
            let samples = samples[starts[mask]..starts[mask + 1]].iter();
            samples.flat_map(|sample| sightings.of(*sample)).for_each(|(view, _)| n_of_view[view] += 1);
            let found = (0u32..).zip(&mut *n_of_view).filter(|(_, n)| **n > 0);
            found.map(|(view, n)| (view, std::mem::take(n))).collect()
        };
        let seen = (0..n_masks).into_par_iter().map_init(|| vec![0; masks.n_views], seen_of).collect();
        Self { sightings, masks, starts, samples, seen }
    }

    fn view_of(&self, mask: u32) -> usize {
        self.masks.view_of_mask[mask as usize] as usize
    }

    fn samples_of(&self, mask: u32) -> &[u32] {
        &self.samples[self.starts[mask as usize]..self.starts[mask as usize + 1]]
    }

    /// Returns the number of a mask's Gaussians that a view sees.
    fn n_seen(&self, mask: u32, view: usize) -> usize {
        let seen = &self.seen[mask as usize];
        seen.binary_search_by_key(&(view as u32), |(view, _)| *view).map_or(0, |at| seen[at].1 as usize)
    }

    fn is_large_enough(&self, mask: u32) -> bool {
        self.samples_of(mask).len() >= MIN_SAMPLES
    }

    /// Judges a mask by all views. Also returns the masks that show the same thing, including itself, ascending; they are
    /// kept for no mask, since their number is known only once they are found.
    fn judge(&self, mask: u32, counts: &mut Counts) -> (Judged, Vec<u32>) {
        let (mut judged, mut same) = (Judged::default(), Vec::new());
        if !self.is_large_enough(mask) {
            return (judged, same);
        }
        counts.add(self.samples_of(mask), self.sightings, self.masks);
        let (own_view, n) = (self.view_of(mask), self.samples_of(mask).len());
        let mut n_judges = 0;
        let mut others = &counts.masks[..];
        for (view, of_view) in counts.of_view.iter().map(|n| *n as usize).enumerate() {
            let (of_this, rest) = others.split_at(others.partition_point(|m| self.view_of(*m) <= view));
            others = rest;
            let mut best = 0.0f64;
            for other in of_this {
                let both = counts.of_mask[*other as usize] as usize;
                let iou = both as f64 / (of_view + self.n_seen(*other, own_view) - both) as f64;
                best = best.max(iou);
                if iou >= SAME_IOU && self.is_large_enough(*other) {
                    same.push(*other);
                }
            }
            if of_view > 0 && of_view * 10 >= n * OBSERVED_TENTHS {
                judged.agreement += best;
                n_judges += 1;
            }
        }
        // Its own view's agreement is always 1.
        if n_judges >= MIN_VIEWS {
            judged.consensus = (judged.agreement - 1.0) / (n_judges - 1) as f64;
        }
        counts.clear();
        (judged, same)
    }

    /// Makes clusters: the masks with most agreement, in turn, gather those like them.
    fn gather(&self, judged: &[Judged], is_cancelled: &dyn Fn() -> bool) -> MaskClusters {
        let n_masks = judged.len() as u32;
        let has_consensus = |mask: &u32| judged[*mask as usize].consensus >= MIN_CONSENSUS;
        let mut seeds: Vec<u32> = (0..n_masks).filter(has_consensus).collect();
        seeds.sort_by(|a, b| {
            let agreement = |mask: &u32| judged[*mask as usize].agreement;
            agreement(b).total_cmp(&agreement(a)).then(a.cmp(b))
        });
        let is_aside = |mask: &u32| self.is_large_enough(*mask) && !has_consensus(mask);
        let mut clusters = MaskClusters {
            cluster_of_mask: vec![NONE; n_masks as usize],
            consensus: Vec::new(),
            n_set_aside: (0..n_masks).filter(is_aside).count(),
        };
        let mut is_gathered = vec![false; n_masks as usize];
        let mut counts = Counts::new(self.masks);
        let mut shape = Shape::new(self);
        for seed in seeds {
            if is_cancelled() {
                break;
            }
            if std::mem::replace(&mut is_gathered[seed as usize], true) {
                continue;
            }
            let (_, same) = self.judge(seed, &mut counts);
            let samples = shape.majority(self, &same);
            counts.add(&samples, self.sightings, self.masks);
            if let Some((members, consensus)) = self.members(samples.len(), &counts) {
                members.iter().for_each(|mask| is_gathered[*mask as usize] = true);
                let is_free = |mask: &&u32| clusters.cluster_of_mask[**mask as usize] == NONE;
                let free: Vec<u32> = members.iter().filter(is_free).copied().collect();
                // Otherwise it is mostly an earlier object.
                if free.len() * 2 >= members.len() {
                    let cluster = clusters.consensus.len() as u32;
                    free.iter().for_each(|mask| clusters.cluster_of_mask[*mask as usize] = cluster);
                    clusters.consensus.push(consensus);
                }
            }
            counts.clear();
        }
        clusters
    }

    /// Returns the masks like a shape of `n` sampled Gaussians, and its consensus; `None` if too few views have any.
    fn members(&self, n: usize, counts: &Counts) -> Option<(Vec<u32>, f64)> {
        let mut members = Vec::new();
        let (mut n_views, mut n_judges, mut agreement) = (0, 0, 0.0);
        let mut others = &counts.masks[..];
        for (view, of_view) in counts.of_view.iter().map(|n| *n as usize).enumerate() {
            let (of_this, rest) = others.split_at(others.partition_point(|m| self.view_of(*m) <= view));
            others = rest;
            let (mut best, n_before) = (0.0f64, members.len());
            for other in of_this {
                let both = counts.of_mask[*other as usize] as usize;
                let iou = both as f64 / (of_view + self.samples_of(*other).len() - both) as f64;
                best = best.max(iou);
                if iou >= SAME_IOU && self.is_large_enough(*other) {
                    members.push(*other);
                }
            }
            n_views += usize::from(members.len() > n_before);
            if of_view > 0 && of_view * 10 >= n * OBJECT_OBSERVED_TENTHS {
                agreement += best;
                n_judges += 1;
            }
        }
        (n_views >= MIN_VIEWS && n_judges > 0).then(|| (members, agreement / f64::from(n_judges)))
    }
}

/// Finds the shape of an object that most views show.
struct Shape {
    is_member: Vec<bool>,
    has_member: Vec<bool>,
    is_taken: Vec<bool>,
}

impl Shape {
    fn new(consensus: &Consensus<'_>) -> Self {
        Self {
            is_member: vec![false; consensus.masks.view_of_mask.len()],
            has_member: vec![false; consensus.masks.n_views],
            is_taken: vec![false; consensus.sightings.len()],
        }
    }

    /// Returns the sampled Gaussians that at least half of the views of some masks show under these, of those views
    /// that see them; ascending.
    fn majority(&mut self, consensus: &Consensus<'_>, masks: &[u32]) -> Vec<u32> {
        for mask in masks {
            self.is_member[*mask as usize] = true;
            self.has_member[consensus.view_of(*mask)] = true;
        }
        let mut samples = Vec::new();
        for sample in masks.iter().flat_map(|mask| consensus.samples_of(*mask)) {
            if std::mem::replace(&mut self.is_taken[*sample as usize], true) {
                continue;
            }
            samples.push(*sample);
        }
        samples.iter().for_each(|sample| self.is_taken[*sample as usize] = false);
        samples.retain(|sample| {
            let sightings = consensus.sightings.of(*sample).filter(|(view, _)| self.has_member[*view]);
            let (inside, n) = sightings.fold((0, 0), |(inside, n), (_, region)| {
                let is_inside =
                    (consensus.masks.of_region)(region).iter().any(|m| self.is_member[*m as usize]);
                (inside + usize::from(is_inside), n + 1)
            });
            2 * inside >= n
        });
        samples.sort_unstable();
        for mask in masks {
            self.is_member[*mask as usize] = false;
            self.has_member[consensus.view_of(*mask)] = false;
        }
        samples
    }
}
