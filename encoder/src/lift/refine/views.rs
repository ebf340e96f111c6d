//! A Gaussian's entries, view by view.

use std::ops::Range;

use rayon::prelude::*;

use crate::lift::part::PartContributions;

/// A Gaussian's entries in one view, and their total weight.
pub(super) struct ViewEntries {
    pub(super) entries: Range<usize>,
    pub(super) weight: f32,
}

/// The first region of each view, ascending.
#[derive(Debug, PartialEq)]
pub(super) struct FirstRegions(pub(super) Vec<u32>);

impl FirstRegions {
    /// Cuts the entries of a Gaussian, ascending by region, into its views.
    pub(super) fn cut(&self, contributions: &PartContributions, entries: Range<usize>) -> Vec<ViewEntries> {
        let mut views: Vec<ViewEntries> = Vec::new();
        let mut end_region = 0;
        for entry in entries {
            let region = contributions.regions[entry];
            if views.is_empty() || region >= end_region {
                let next = self.0.partition_point(|first| *first <= region);
                end_region = self.0.get(next).copied().unwrap_or(u32::MAX);
                views.push(ViewEntries { entries: entry..entry, weight: 0.0 });
            }
            if let Some(view) = views.last_mut() {
                view.entries.end = entry + 1;
                view.weight += contributions.weights[entry];
            }
        }
        views
    }

    /// Multiplies the entries of each Gaussian's views by factors. The evidence, the total weight, does not change.
    pub(super) fn scale(
        &self,
        contributions: &mut PartContributions,
        factors: impl Fn(&PartContributions, &[ViewEntries]) -> Vec<f32> + Sync,
    ) {
        let n = contributions.total_weights.len();
        let factors_of = |k: usize| -> Vec<(Range<usize>, f32)> {
            let views = self.cut(contributions, contributions.entries_of(k));
            let factors = factors(contributions, &views);
            views.into_iter().map(|view| view.entries).zip(factors).collect()
        };
        let factors: Vec<Vec<(Range<usize>, f32)>> = (0..n).into_par_iter().map(factors_of).collect();
        for (entries, factor) in factors.into_iter().flatten() {
            contributions.weights[entries].iter_mut().for_each(|weight| *weight *= factor);
        }
    }
}
