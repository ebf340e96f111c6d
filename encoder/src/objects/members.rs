//! Each Gaussian's object, by its weight under the objects' masks.

use rayon::prelude::*;

use super::consensus::MaskClusters;
use super::object::NONE;
use super::scene::Scene;
use crate::lift::{ContributionError, PartContributions, RegionTable};
use crate::memory::{MemoryPlan, Phase};

/// Smallest share of a Gaussian's weight under an object's masks: a majority.
const MIN_WEIGHT_SHARE: f32 = 0.5;

/// The Gaussians and masks of each object.
pub struct Members {
    /// `[cell][N of the cell]`: the object of each Gaussian, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// The masks of each object, ascending.
    pub masks: Vec<Vec<u32>>,
    /// `[n_masks]`: blending weight of all Gaussians under the mask, pixels.
    pub mask_weights: Vec<f64>,
    /// `[n_masks]`: of that, the weight of its object's Gaussians.
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

/// Reserves the object of each Gaussian.
pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    memory.reserve(Phase::Always, "the object of each Gaussian", (n_gaussians * size_of::<u32>()) as u64);
}

impl Members {
    /// Assigns each Gaussian to the cluster with the largest product of its weight there and the cluster's consensus, among
    /// clusters with most of its weight. Returns `None` if cancelled.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn assign(scene: &Scene<'_>, clusters: &MaskClusters) -> Result<Option<Self>, ContributionError> {
        let of_region = ClustersOfRegion::new(scene.table, clusters);
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
                    || (vec![0.0f32; clusters.consensus.len()], Vec::new()),
                    |(weights, touched), k| {
                        best_cluster(&contributions, k, &of_region, clusters, weights, touched)
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

/// Returns the cluster of a Gaussian. `weights`, `touched`: working memory, zeros and empty.
fn best_cluster(
    contributions: &PartContributions,
    k: usize,
    of_region: &ClustersOfRegion,
    clusters: &MaskClusters,
    weights: &mut [f32],
    touched: &mut Vec<u32>,
) -> u32 {
    let mut total = 0.0;
    for entry in contributions.starts[k] as usize..contributions.starts[k + 1] as usize {
        let weight = contributions.weights[entry];
        total += weight;
        for cluster in of_region.of(contributions.regions[entry]) {
            let sum = &mut weights[*cluster as usize];
            if *sum == 0.0 {
                touched.push(*cluster);
            }
            *sum += weight;
        }
    }
    touched.sort_unstable();
    touched.dedup();
    let (mut best, mut most) = (NONE, 0.0);
    for cluster in touched.drain(..) {
        let weight = std::mem::take(&mut weights[cluster as usize]);
        let merit = f64::from(weight) * clusters.consensus[cluster as usize];
        if weight >= MIN_WEIGHT_SHARE * total && merit > most {
            (best, most) = (cluster, merit);
        }
    }
    best
}
