//! Drops contributions that say little about their Gaussian: those of a region that the Gaussian only touches, of a view that
//! hardly shows it, and of a Gaussian that hardly shows anywhere.

use rayon::prelude::*;

use super::settings::Aggregation;
use super::views::FirstRegions;
use crate::lift::part::PartContributions;

/// Gaussians that a thread works on at a time.
const CHUNK: usize = 4096;

/// Drops the contributions that the settings exclude. `mask_counts`: `[n_regions]`, the summed weight of each region's masks.
pub(super) fn prune(
    contributions: &mut PartContributions,
    settings: &Aggregation,
    first_regions: &FirstRegions,
    mask_counts: &[f32],
) {
    let Aggregation { min_region_share, min_view_share, min_weight_px, .. } = *settings;
    if min_region_share <= 0.0 && min_view_share <= 0.0 && min_weight_px <= 0.0 {
        return;
    }
    let n = contributions.total_weights.len();
    let kept_of_chunk = |first: usize| -> Vec<Vec<u32>> {
        let weights = &contributions.weights;
        let kept_of = |k: usize| {
            let views = first_regions.cut(contributions, contributions.entries_of(k));
            let best = views.iter().map(|view| view.weight).fold(0.0, f32::max);
            if views.iter().map(|view| view.weight).sum::<f32>() < min_weight_px {
                return Vec::new();
            }
            let seen = views.into_iter().filter(|view| view.weight >= min_view_share * best);
            seen.flat_map(|view| {
                let largest = weights[view.entries.clone()].iter().copied().fold(0.0, f32::max);
                let large = move |entry: &usize| weights[*entry] >= min_region_share * largest;
                view.entries.filter(large).map(|entry| entry as u32)
            })
            .collect()
        };
        (first..(first + CHUNK).min(n)).map(kept_of).collect()
    };
    let firsts: Vec<usize> = (0..n).step_by(CHUNK).collect();
    let kept: Vec<Vec<u32>> = firsts.into_par_iter().flat_map_iter(kept_of_chunk).collect();
    let mut at = 0;
    for (k, kept) in kept.into_iter().enumerate() {
        let mut total = 0.0;
        for entry in kept {
            let entry = entry as usize;
            (contributions.regions[at], contributions.weights[at]) =
                (contributions.regions[entry], contributions.weights[entry]);
            total += f64::from(contributions.weights[at])
                * f64::from(mask_counts[contributions.regions[at] as usize]);
            at += 1;
        }
        contributions.starts[k + 1] = at as u64;
        contributions.total_weights[k] = total as f32;
    }
    contributions.regions.truncate(at);
    contributions.weights.truncate(at);
}
