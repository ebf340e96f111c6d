//! The region of each sampled Gaussian in each view.

use rayon::prelude::*;

use super::consensus::Sightings;
use super::scene::Scene;
use crate::lift::ContributionError;
use crate::memory::{MemoryPlan, Phase};

/// Approximate number of sampled Gaussians: the time of [`super::consensus`] grows with it, and each mask needs a few.
const MAX_SAMPLES: usize = 32_768;
/// A view sees a Gaussian if its weight there is at least this share of that in its best view: remnants behind other
/// Gaussians say nothing.
const MIN_WEIGHT_SHARE: f32 = 0.1;

/// Returns the step between sampled Gaussians of a cell. These lie along its Morton curve, so the sample is spread evenly.
pub fn sample_step(n_gaussians: usize) -> usize {
    n_gaussians.div_ceil(MAX_SAMPLES).max(1)
}

/// Reserves the bytes that sightings take at most: every view sees every sampled Gaussian.
pub(super) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize, n_views: usize) {
    let n_sampled = n_gaussians / sample_step(n_gaussians);
    let len_bytes = n_sampled * (size_of::<usize>() + n_views * 2 * size_of::<u32>());
    memory.reserve_expecting(Phase::Objects, "views of sampled Gaussians", len_bytes as u64, 0);
}

/// Returns the bytes of the sightings among `n_entries` contributions, and of their masks.
pub fn expected_bytes(n_entries: u64, n_gaussians: usize) -> u64 {
    n_entries / sample_step(n_gaussians) as u64 * 3 * size_of::<u32>() as u64
}

/// Reserves the lists of the masks that show the sampled Gaussians: at most `most_masks` in a region, and for each mask the
/// views that see some of its Gaussians.
pub(super) fn reserve_masks(
    memory: &mut MemoryPlan,
    n_gaussians: usize,
    n_views: usize,
    (n_masks, most_masks): (usize, usize),
) {
    let n_sightings = n_gaussians / sample_step(n_gaussians) * n_views;
    let samples_bytes = n_sightings * most_masks * size_of::<u32>();
    let seen_bytes = n_masks * n_views * size_of::<(u32, u32)>();
    memory.reserve(Phase::Objects, "masks of sampled Gaussians", (samples_bytes + seen_bytes) as u64);
}

/// Gathers the sightings of every `step`-th Gaussian of each cell. Returns `None` if cancelled.
///
/// # Errors
/// [`ContributionError`].
pub fn gather(scene: &Scene<'_>, step: usize) -> Result<Option<Sightings>, ContributionError> {
    let Scene { index, table, group_bytes, .. } = *scene;
    let view_of_region = scene.view_of_region();
    let mut all = Sightings { starts: vec![0], views: Vec::new(), regions: Vec::new() };
    for contributions in index.transposed_parts(table, group_bytes) {
        if scene.is_cancelled() {
            return Ok(None);
        }
        let contributions = contributions?;
        let locals = &contributions.part.locals;
        let sampled: Vec<usize> = locals.clone().filter(|local| local % step == 0).collect();
        let sighted: Vec<Vec<(u32, u32)>> = sampled
            .par_iter()
            .map(|local| {
                let entries = contributions.entries_of(local - locals.start);
                of_gaussian(
                    &contributions.regions[entries.clone()],
                    &contributions.weights[entries],
                    &view_of_region,
                )
            })
            .collect();
        for of_gaussian in sighted {
            all.views.extend(of_gaussian.iter().map(|(view, _)| view));
            all.regions.extend(of_gaussian.iter().map(|(_, region)| region));
            all.starts.push(all.views.len());
        }
    }
    Ok(Some(all))
}

/// Returns (view, region) of each view that sees a Gaussian. Entries are by view, then region.
fn of_gaussian(regions: &[u32], weights: &[f32], view_of_region: &[u32]) -> Vec<(u32, u32)> {
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
    views.iter().filter(is_seen).map(|(view, _, region, _)| (*view, *region)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computed by hand: view 0 shows regions 0 and 1, view 1 regions 2 to 4, view 2 less than a tenth, view 3 nothing.
    #[test]
    fn a_gaussian_shows_the_region_of_most_weight_where_it_is_seen() {
        let view_of_region = [0, 0, 1, 1, 1, 2, 3];
        let (regions, weights) = ([0, 1, 2, 3, 4, 5, 6], [1.0, 3.0, 4.0, 4.0, 2.0, 0.9, 0.0]);
        assert_eq!(of_gaussian(&regions, &weights, &view_of_region), [(0, 1), (1, 2)]);
        // A tenth of the best is enough.
        assert_eq!(of_gaussian(&regions, &[1.0, 3.0, 4.0, 4.0, 2.0, 1.0, 0.0], &view_of_region).len(), 3);
        assert_eq!(of_gaussian(&[], &[], &view_of_region), []);
        assert_eq!(sample_step(1), 1);
        assert_eq!((sample_step(32_768), sample_step(32_769), sample_step(104_878)), (1, 2, 4));
    }
}
