//! Drops the contributions of views that hardly show their Gaussian.

use std::ops::Range;

use rayon::prelude::*;

use crate::lift::index::PartContributions;

/// Least number of Gaussians per task.
const CHUNK: usize = 4096;

struct ViewEntries {
    entries: Range<usize>,
    weight: f32,
}

/// Splits a Gaussian's entries, ascending by region, by view. `first_regions`: of each view, ascending.
fn by_view(
    contributions: &PartContributions,
    entries: Range<usize>,
    first_regions: &[u32],
) -> Vec<ViewEntries> {
    let mut views: Vec<ViewEntries> = Vec::new();
    let mut end_region = 0;
    for entry in entries {
        let region = contributions.regions[entry];
        if views.is_empty() || region >= end_region {
            let next = first_regions.partition_point(|first| *first <= region);
            end_region = first_regions.get(next).copied().unwrap_or(u32::MAX);
            views.push(ViewEntries { entries: entry..entry, weight: 0.0 });
        }
        if let Some(view) = views.last_mut() {
            view.entries.end = entry + 1;
            view.weight += contributions.weights[entry];
        }
    }
    views
}

/// Drops entries of views where a Gaussian has less than `min_view_share` of its weight in its best view.
/// `mask_counts`: `[n_regions]`, summed weight of the region's masks.
pub(super) fn prune(
    contributions: &mut PartContributions,
    min_view_share: f32,
    first_regions: &[u32],
    mask_counts: &[f32],
) {
    if min_view_share <= 0.0 {
        return;
    }
    let kept_of = |k: usize| -> Vec<Range<usize>> {
        let views = by_view(contributions, contributions.entries_of(k), first_regions);
        let best = views.iter().map(|view| view.weight).fold(0.0, f32::max);
        let seen = views.into_iter().filter(|view| view.weight >= min_view_share * best);
        seen.map(|view| view.entries).collect()
    };
    let n = contributions.total_weights.len();
    let kept: Vec<Vec<Range<usize>>> = (0..n).into_par_iter().with_min_len(CHUNK).map(kept_of).collect();
    let mut at = 0;
    for (k, kept) in kept.into_iter().enumerate() {
        let mut total = 0.0;
        for entry in kept.into_iter().flatten() {
            let (region, weight) = (contributions.regions[entry], contributions.weights[entry]);
            (contributions.regions[at], contributions.weights[at]) = (region, weight);
            total += f64::from(weight) * f64::from(mask_counts[region as usize]);
            at += 1;
        }
        contributions.starts[k + 1] = at as u64;
        contributions.total_weights[k] = total as f32;
    }
    contributions.regions.truncate(at);
    contributions.weights.truncate(at);
}
