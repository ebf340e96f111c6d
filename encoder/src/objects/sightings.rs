//! What each view shows of each superpoint: how many of its Gaussians, and under which masks.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::lift::superpoint::{NO_SUPERPOINT, Superpoints};
use crate::lift::{ContributionError, PartContributions, RegionTable, SceneContributions};
use crate::memory::{MemoryPlan, Phase};

/// Least weight of a seen Gaussian relative to its best view: remnants behind others say nothing.
const MIN_WEIGHT_SHARE: f32 = 0.1;
const GAUSSIANS_PER_TASK: usize = 1 << 12;
/// Contributions for each pair of superpoint and region: those of the Gaussians of a superpoint, 15 in labelled
/// scenes.
const ENTRIES_PER_REGION: u64 = 8;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ViewSighting<'a> {
    pub(super) view: u32,
    /// The superpoint's Gaussians that it sees.
    pub(super) n: u32,
    /// Blending weight of these and of hidden ones.
    pub(super) weight_px: f64,
    /// Masks that show it, ascending, without fillers, whose outlines say nothing.
    pub(super) masks: &'a [MaskSighting],
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct MaskSighting {
    pub(super) mask: u32,
    /// The superpoint's Gaussians that the view sees under it.
    pub(super) n: u32,
    /// Blending weight of the superpoint under the mask, pixels.
    pub(super) weight: f64,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Sightings {
    /// `[n + 1]`: start of each superpoint's views.
    starts: Vec<usize>,
    /// View, Gaussians, weight, and start of its masks; one more at the end.
    views: Vec<(u32, u32, f64, usize)>,
    masks: Vec<MaskSighting>,
}

#[derive(Clone, Copy)]
struct Entry {
    superpoint: u32,
    region: u32,
    n: u32,
    weight: f64,
}

pub(crate) fn reserve(memory: &mut MemoryPlan, n_entries: u64) {
    let bytes_per_region = (size_of::<Entry>() + size_of::<MaskSighting>()) as u64;
    memory.reserve(Phase::Objects, "masks of superpoints", n_entries / ENTRIES_PER_REGION * bytes_per_region);
}

impl Sightings {
    /// One pass over all contributions.
    pub(super) fn gather(
        scene: &SceneContributions<'_>,
        table: &RegionTable,
        superpoints: &Superpoints,
    ) -> Result<Self, ContributionError> {
        let regions = (0u32..).zip(scene.index.views.iter().map(|view| view.file.n_regions));
        let view_of_region: Vec<u32> = regions.flat_map(|(view, n)| std::iter::repeat_n(view, n)).collect();
        let mut entries = Vec::new();
        for contributions in scene.index.transposed_parts(table, scene.group_bytes) {
            scene.check_cancelled()?;
            let contributions = contributions?;
            let gaussians = contributions.part.gaussians(scene.split);
            let chunks = gaussians.par_chunks(GAUSSIANS_PER_TASK).enumerate();
            let found: Vec<Vec<Entry>> = chunks
                .map(|(at, gaussians)| {
                    let first = at * GAUSSIANS_PER_TASK;
                    of_gaussians(&contributions, first, gaussians, superpoints, &view_of_region)
                })
                .collect();
            found.into_iter().for_each(|mut found| entries.append(&mut found));
        }
        // Stable: entries of a pair stay in the order of parts, so sums are the same every time.
        entries.par_sort_by_key(|entry| (entry.superpoint, entry.region));
        Ok(Self::new(superpoints.n, &join(entries), table, &view_of_region))
    }

    fn new(n: usize, entries: &[Entry], table: &RegionTable, view_of_region: &[u32]) -> Self {
        let mut sightings = Self { starts: Vec::with_capacity(n + 1), views: Vec::new(), masks: Vec::new() };
        let view_of = |entry: &Entry| view_of_region[entry.region as usize];
        let mut rest = entries;
        for superpoint in 0..n as u32 {
            sightings.starts.push(sightings.views.len());
            let own;
            (own, rest) = rest.split_at(rest.partition_point(|entry| entry.superpoint <= superpoint));
            for of_view in own.chunk_by(|a, b| view_of(a) == view_of(b)) {
                let first = sightings.masks.len();
                let n_seen = of_view.iter().map(|entry| entry.n).sum();
                let weight = of_view.iter().map(|entry| entry.weight).sum();
                sightings.views.push((view_of(&of_view[0]), n_seen, weight, first));
                let outlined = of_view.iter().filter(|entry| !table.is_filled(entry.region as usize));
                let mut masks: BTreeMap<u32, (u32, f64)> = BTreeMap::new();
                for entry in outlined {
                    for mask in table.all_masks_of(entry.region as usize) {
                        let (n, weight) = masks.entry(*mask).or_default();
                        (*n, *weight) = (*n + entry.n, *weight + entry.weight);
                    }
                }
                let masks = masks.into_iter().map(|(mask, (n, weight))| MaskSighting { mask, n, weight });
                sightings.masks.extend(masks);
            }
        }
        sightings.starts.push(sightings.views.len());
        sightings.views.push((0, 0, 0.0, sightings.masks.len()));
        sightings
    }

    pub(super) fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// By view, ascending.
    pub(super) fn of(&self, superpoint: usize) -> impl Iterator<Item = ViewSighting<'_>> {
        (self.starts[superpoint]..self.starts[superpoint + 1]).map(|at| {
            let (view, n, weight_px, first) = self.views[at];
            ViewSighting { view, n, weight_px, masks: &self.masks[first..self.views[at + 1].3] }
        })
    }

    /// All masks, by superpoint.
    pub(super) fn masks(&self) -> impl Iterator<Item = (usize, &MaskSighting)> {
        (0..self.len())
            .flat_map(|at| self.of(at).flat_map(move |of_view| of_view.masks.iter().map(move |of| (at, of))))
    }
}

/// Entries of superpoints and regions, from consecutive Gaussians of a part.
fn of_gaussians(
    contributions: &PartContributions,
    first: usize,
    gaussians: &[u32],
    superpoints: &Superpoints,
    view_of_region: &[u32],
) -> Vec<Entry> {
    let mut found = Vec::new();
    for (k, gaussian) in (first..).zip(gaussians) {
        let superpoint = superpoints.of_gaussian[*gaussian as usize];
        if superpoint == NO_SUPERPOINT {
            continue;
        }
        let entries = contributions.entries_of(k);
        let (regions, weights) = (&contributions.regions[entries.clone()], &contributions.weights[entries]);
        let seen = seen(regions, weights, view_of_region);
        let mut seen = seen.iter().peekable();
        found.extend(regions.iter().zip(weights).map(|(region, weight)| {
            let n = u32::from(seen.next_if_eq(&region).is_some());
            Entry { superpoint, region: *region, n, weight: f64::from(*weight) }
        }));
    }
    found.sort_by_key(|entry| (entry.superpoint, entry.region));
    join(found)
}

/// Sums entries of equal pairs, which are sorted by pair.
fn join(mut entries: Vec<Entry>) -> Vec<Entry> {
    entries.dedup_by(|next, kept| {
        let is_same = (next.superpoint, next.region) == (kept.superpoint, kept.region);
        if is_same {
            kept.n += next.n;
            kept.weight += next.weight;
        }
        is_same
    });
    entries
}

/// For each view that sees a Gaussian, the region with most of its weight. Entries are by view, then region.
fn seen(regions: &[u32], weights: &[f32], view_of_region: &[u32]) -> Vec<u32> {
    let mut views: Vec<(u32, f32, u32, f32)> = Vec::new();
    for (region, weight) in regions.iter().zip(weights) {
        let view = view_of_region[*region as usize];
        match views.last_mut() {
            Some((last, total, best, most)) if *last == view => {
                *total += weight;
                if weight > most {
                    (*best, *most) = (*region, *weight);
                }
            }
            _ => views.push((view, *weight, *region, *weight)),
        }
    }
    let most = views.iter().map(|(_, total, ..)| *total).fold(0.0, f32::max);
    let is_seen = |(_, total, ..): &&(u32, f32, u32, f32)| *total > 0.0 && *total >= MIN_WEIGHT_SHARE * most;
    views.iter().filter(is_seen).map(|(_, _, region, _)| *region).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: view 0 shows regions 0 and 1, view 1 regions 2 to 4, view 2 less than a tenth, view 3 nothing.
    #[test]
    fn a_gaussian_shows_the_region_of_most_weight_where_it_is_seen() {
        let view_of_region = [0, 0, 1, 1, 1, 2, 3];
        let (regions, weights) = ([0, 1, 2, 3, 4, 5, 6], [1.0, 3.0, 4.0, 4.0, 2.0, 0.9, 0.0]);
        assert_eq!(seen(&regions, &weights, &view_of_region), [1, 2]);
        // A tenth of the best is enough.
        assert_eq!(seen(&regions, &[1.0, 3.0, 4.0, 4.0, 2.0, 1.0, 0.0], &view_of_region).len(), 3);
        assert!(seen(&[], &[], &view_of_region).is_empty());
    }
}
