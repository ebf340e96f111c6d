//! Each Gaussian's object, by its weight under the objects' masks.

use rayon::prelude::*;

use super::consensus::MaskClusters;
use super::object::NONE;
use super::scene::Scene;
use super::views::ViewsOfClusters;
use crate::lift::{ContributionError, PartContributions, RegionTable};
use crate::memory::{MemoryPlan, Phase};

/// Smallest share of a Gaussian's weight that lies under an object's masks, in the views that have such masks.
const MIN_SHARE_WHERE_SHOWN: f32 = 0.6;
/// The same in all views: few masks say little.
const MIN_SHARE: f32 = 0.2;

/// The Gaussians and masks of each object.
pub struct Members {
    /// `[cell][N of the cell]`: the object of each Gaussian, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// The masks of each object, ascending.
    pub masks: Vec<Vec<u32>>,
    /// `[n_masks]`: blending weight of all Gaussians under the mask, pixels.
    pub mask_weights: Vec<f64>,
    /// `[n_masks]`: of that, the weight of the Gaussians that are its object's by their own weights.
    pub own_weights: Vec<f64>,
}

/// The clusters of each region's masks.
struct ClustersOfRegion {
    starts: Vec<u32>,
    clusters: Vec<u32>,
}

impl ClustersOfRegion {
    fn new(table: &RegionTable, clusters: &MaskClusters) -> Self {
        let mut of_region = Self { starts: vec![0], clusters: Vec::new() };
        let mut found = Vec::new();
        for region in 0..table.len() {
            found.clear();
            found.extend(
                table.all_masks_of(region).iter().map(|mask| clusters.cluster_of_mask[*mask as usize]),
            );
            found.retain(|cluster| *cluster != NONE);
            found.sort_unstable();
            found.dedup();
            of_region.clusters.extend(&found);
            of_region.starts.push(of_region.clusters.len() as u32);
        }
        of_region
    }

    fn of(&self, region: u32) -> &[u32] {
        &self.clusters[self.starts[region as usize] as usize..self.starts[region as usize + 1] as usize]
    }
}

/// What decides a Gaussian's object.
struct Choice<'a> {
    clusters: &'a MaskClusters,
    of_region: ClustersOfRegion,
    views: ViewsOfClusters,
    view_of_region: Vec<u32>,
}

/// Working memory of a choice.
struct Sums {
    /// By cluster: the Gaussian's weight under its masks. Zeros between choices.
    weights: Vec<f32>,
    /// Clusters with a weight.
    touched: Vec<u32>,
    /// The Gaussian's weight in each view.
    views: Vec<(u32, f32)>,
}

/// Reserves the object of each Gaussian.
pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    memory.reserve(Phase::Always, "the object of each Gaussian", (n_gaussians * size_of::<u32>()) as u64);
}

impl Members {
    /// Assigns each Gaussian to a cluster. Only the views that have masks of a cluster count for it, since segmenters miss
    /// things in many views: the cluster wins whose masks have the largest share of the Gaussian's weight in those views,
    /// times the cluster's consensus. Returns `None` if cancelled.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn assign(scene: &Scene<'_>, clusters: &MaskClusters) -> Result<Option<Self>, ContributionError> {
        let choice = Choice {
            clusters,
            of_region: ClustersOfRegion::new(scene.table, clusters),
            views: ViewsOfClusters::new(clusters, &scene.view_of_mask()),
            view_of_region: scene.view_of_region(),
        };
        let n_masks = scene.table.n_masks();
        let mut masks = vec![Vec::new(); clusters.consensus.len()];
        for (mask, cluster) in clusters.cluster_of_mask.iter().enumerate().filter(|(_, c)| **c != NONE) {
            masks[*cluster as usize].push(mask as u32);
        }
        let mut members = Self {
            object_of: scene.split.cells.iter().map(|cell| vec![NONE; cell.gaussians.len()]).collect(),
            masks,
            mask_weights: vec![0.0; n_masks],
            own_weights: vec![0.0; n_masks],
        };
        for contributions in scene.index.transposed_parts(scene.table, scene.group_bytes) {
            if scene.is_cancelled() {
                return Ok(None);
            }
            let contributions = contributions?;
            let found: Vec<u32> = (0..contributions.part.locals.len())
                .into_par_iter()
                .map_init(
                    || Sums::new(clusters.consensus.len()),
                    |sums, k| {
                        let entries = contributions.entries_of(k);
                        let regions = &contributions.regions[entries.clone()];
                        choice.of(regions, &contributions.weights[entries], sums)
                    },
                )
                .collect();
            members.add_weights(&contributions, &found, scene.table, clusters);
            let of_cell = &mut members.object_of[contributions.part.cell_id as usize];
            of_cell[contributions.part.locals.clone()].copy_from_slice(&found);
        }
        Ok(Some(members))
    }

    /// Adds a part's weights to those of its masks, in one order: the sums are the same every time.
    fn add_weights(
        &mut self,
        contributions: &PartContributions,
        cluster_of: &[u32],
        table: &RegionTable,
        clusters: &MaskClusters,
    ) {
        for (k, cluster) in cluster_of.iter().enumerate() {
            for entry in contributions.starts[k] as usize..contributions.starts[k + 1] as usize {
                let weight = f64::from(contributions.weights[entry]);
                for mask in table
                    .all_masks_of(contributions.regions[entry] as usize)
                    .iter()
                    .map(|mask| *mask as usize)
                {
                    self.mask_weights[mask] += weight;
                    if *cluster != NONE && clusters.cluster_of_mask[mask] == *cluster {
                        self.own_weights[mask] += weight;
                    }
                }
            }
        }
    }

    /// Drops objects with fewer Gaussians and renumbers the others in order.
    pub fn drop_small(&mut self, min_gaussians: usize) {
        let mut n_of = vec![0usize; self.masks.len()];
        self.object_of.iter().flatten().filter(|o| **o != NONE).for_each(|o| n_of[*o as usize] += 1);
        let mut number_of = vec![NONE; self.masks.len()];
        let kept = (0..n_of.len()).filter(|object| n_of[*object] >= min_gaussians.max(1));
        (0u32..).zip(kept).for_each(|(number, object)| number_of[object] = number);
        for object in self.object_of.iter_mut().flatten().filter(|object| **object != NONE) {
            *object = number_of[*object as usize];
        }
        let mut number = number_of.iter();
        self.masks.retain(|_| number.next().is_some_and(|number| *number != NONE));
    }

    /// Returns the mask that shows an object best: the one with the largest product of the weight of the object's
    /// Gaussians, their share of the mask's weight, and 1 - truncation.
    pub fn best_mask(&self, masks: &[u32], uncut_shares: &[f32]) -> u32 {
        let merit = |mask: u32| {
            let (own, all) = (self.own_weights[mask as usize], self.mask_weights[mask as usize]);
            if all > 0.0 { own * own / all * f64::from(uncut_shares[mask as usize]) } else { 0.0 }
        };
        let better = |a: u32, b: u32| if merit(b) > merit(a) { b } else { a };
        masks.iter().copied().reduce(better).unwrap_or(NONE)
    }
}

impl Sums {
    fn new(n_clusters: usize) -> Self {
        Self { weights: vec![0.0; n_clusters], touched: Vec::new(), views: Vec::new() }
    }
}

impl Choice<'_> {
    /// Returns the cluster of a Gaussian, or [`NONE`]. Its entries are by view.
    fn of(&self, regions: &[u32], weights_of_regions: &[f32], sums: &mut Sums) -> u32 {
        let Sums { weights, touched, views } = sums;
        views.clear();
        for (region, weight) in regions.iter().zip(weights_of_regions) {
            let view = self.view_of_region[*region as usize];
            match views.last_mut() {
                Some((last, sum)) if *last == view => *sum += weight,
                _ => views.push((view, *weight)),
            }
            for cluster in self.of_region.of(*region) {
                let sum = &mut weights[*cluster as usize];
                if *sum == 0.0 {
                    touched.push(*cluster);
                }
                *sum += weight;
            }
        }
        touched.sort_unstable();
        touched.dedup();
        let total: f32 = views.iter().map(|(_, weight)| weight).sum();
        let (mut best, mut most) = (NONE, 0.0);
        for cluster in touched.drain(..) {
            let weight = std::mem::take(&mut weights[cluster as usize]);
            let is_shown = |(view, _): &&(u32, f32)| self.views.has(cluster, *view);
            let shown: f32 = views.iter().filter(is_shown).map(|(_, weight)| weight).sum();
            let merit = f64::from(weight / shown) * self.clusters.consensus[cluster as usize];
            if weight >= MIN_SHARE_WHERE_SHOWN * shown && weight >= MIN_SHARE * total && merit > most {
                (best, most) = (cluster, merit);
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    const N_VIEWS: u32 = 70;
    const MASKS_PER_VIEW: u32 = 4;

    /// Every set of a view's masks is a region. Some masks are in no cluster, some clusters have none in a view.
    fn random_choice<'a>(
        random: &mut Random,
        table: &mut RegionTable,
        clusters: &'a mut MaskClusters,
    ) -> Choice<'a> {
        let regions: Vec<Vec<u32>> = (0..1 << MASKS_PER_VIEW)
            .map(|set| (0..MASKS_PER_VIEW).filter(|m| set >> m & 1 == 1).collect())
            .collect();
        for _ in 0..N_VIEWS {
            table.append(&vec![1.0; MASKS_PER_VIEW as usize], regions.iter().map(Vec::as_slice));
        }
        clusters.cluster_of_mask =
            (0..N_VIEWS * MASKS_PER_VIEW).map(|_| [0, 1, 2, 3, NONE][random.below(5) as usize]).collect();
        clusters.consensus = vec![0.9, 0.6, 0.7, 0.8];
        let view_of_mask: Vec<u32> =
            (0..N_VIEWS * MASKS_PER_VIEW).map(|mask| mask / MASKS_PER_VIEW).collect();
        Choice {
            of_region: ClustersOfRegion::new(table, clusters),
            views: ViewsOfClusters::new(clusters, &view_of_mask),
            view_of_region: (0..table.len() as u32).map(|region| region >> MASKS_PER_VIEW).collect(),
            clusters,
        }
    }

    /// Oracle: the definition in float64, over all masks of all views. Returns the cluster, and whether rounding may change it.
    fn oracle(row: &[(u32, f32)], table: &RegionTable, clusters: &MaskClusters) -> (u32, bool) {
        let view_of = |region: u32| region >> MASKS_PER_VIEW;
        let sum = |counts: &dyn Fn(u32) -> bool| -> f64 {
            row.iter().filter(|(region, _)| counts(*region)).map(|(_, weight)| f64::from(*weight)).sum()
        };
        let (mut best, mut most, mut is_near) = (NONE, 0.0, false);
        for (cluster, consensus) in (0u32..).zip(&clusters.consensus) {
            let is_of = |mask: u32| clusters.cluster_of_mask[mask as usize] == cluster;
            let under = sum(&|region| table.all_masks_of(region as usize).iter().any(|mask| is_of(*mask)));
            let shown =
                sum(&|region| (0..MASKS_PER_VIEW).any(|mask| is_of(view_of(region) * MASKS_PER_VIEW + mask)));
            let total = sum(&|_| true);
            let merit = under / shown * consensus;
            let from_a_border = [under - 0.6 * shown, under - 0.2 * total, merit - most].map(f64::abs);
            is_near |= under > 0.0 && from_a_border.iter().any(|distance| *distance < 1e-5);
            if under > 0.0 && under >= 0.6 * shown && under >= 0.2 * total && merit > most {
                (best, most) = (cluster, merit);
            }
        }
        (best, is_near)
    }

    #[test]
    fn a_gaussian_is_of_the_object_that_the_definition_says() {
        let (mut n_of, mut n_near) = ([0; 5], 0);
        for seed in 0..40 {
            let mut random = Random::new(seed);
            let (mut table, mut clusters) = (RegionTable::new(1), MaskClusters::default());
            let choice = random_choice(&mut random, &mut table, &mut clusters);
            let mut sums = Sums::new(4);
            for _ in 0..50 {
                // Few views, so that one view's mask matters, in order; one region or two of each.
                let first = random.below(60) as u32;
                let mut row: Vec<(u32, f32)> = Vec::new();
                for view in (first..first + 10).filter(|_| random.below(3) > 0).collect::<Vec<u32>>() {
                    for _ in 0..1 + random.below(2) {
                        let region = view << MASKS_PER_VIEW | random.below(1 << MASKS_PER_VIEW) as u32;
                        row.push((region, 0.1 + random.below(1000) as f32 / 300.0));
                    }
                }
                row.sort_by_key(|(region, _)| *region);
                let (regions, weights): (Vec<u32>, Vec<f32>) = row.iter().copied().unzip();
                let (expected, is_near) = oracle(&row, &table, choice.clusters);
                if is_near {
                    n_near += 1;
                    continue;
                }
                assert_eq!(choice.of(&regions, &weights, &mut sums), expected, "{seed} {row:?}");
                n_of[expected.min(4) as usize] += 1;
                // Nothing is left from one Gaussian to the next.
                assert_eq!(choice.of(&[], &[], &mut sums), NONE);
            }
        }
        assert!(n_of.iter().all(|n| *n > 20) && n_near < 100, "{n_of:?} {n_near}");
    }
}
