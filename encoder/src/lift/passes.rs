//! A pass over the contributions of all parts. The lift, its refinements and the objects need several: where the budget
//! holds all parts, the first pass keeps them and later passes read no file.

use std::ops::Range;

use rayon::prelude::*;

use super::contributions::ContributionError;
use super::index::ContributionIndex;
use super::part::PartContributions;
use super::table::RegionTable;

/// One pass over the transposed contributions, part by part in the order of [`ContributionIndex::parts`].
pub struct TransposedParts<'a> {
    index: &'a ContributionIndex,
    table: &'a RegionTable,
    source: Source<'a>,
}

enum Source<'a> {
    Files {
        /// Groups to be read.
        groups: std::vec::IntoIter<Range<usize>>,
        /// The rest of the last group.
        transposed: std::vec::IntoIter<PartContributions>,
        /// Copies of all parts so far, if they are to be kept.
        kept: Option<Vec<PartContributions>>,
    },
    Memory {
        parts: std::slice::Iter<'a, PartContributions>,
        /// `[n_regions]`: summed weight of each region's masks.
        mask_counts: Vec<f32>,
    },
}

impl ContributionIndex {
    /// Returns what passes want of a budget: enough to keep all parts, if that is in the budget, else half.
    pub fn budget_bytes(&self, budget_bytes: u64) -> u64 {
        let to_keep_bytes = self.kept_bytes().saturating_add(self.largest_part_bytes()).saturating_mul(2);
        let wanted_bytes = if to_keep_bytes <= budget_bytes { to_keep_bytes } else { budget_bytes / 2 };
        wanted_bytes.max(self.largest_part_bytes())
    }

    /// Starts a pass that takes at most `budget_bytes`, or what the largest part needs. Total weights follow the table's
    /// present weights of masks.
    pub fn transposed_parts<'a>(&'a self, table: &'a RegionTable, budget_bytes: u64) -> TransposedParts<'a> {
        let source = match self.kept.get() {
            Some(parts) => {
                Source::Memory { parts: parts.iter(), mask_counts: table.mask_counts(0..table.len()) }
            }
            None => {
                // Half the budget: refinement and objects build lists of their own, which also grow with the entries.
                let keeps = self.kept_bytes().saturating_add(self.largest_part_bytes()) <= budget_bytes / 2;
                let for_groups = if keeps { budget_bytes - self.kept_bytes() } else { budget_bytes };
                Source::Files {
                    groups: self.groups(for_groups).into_iter(),
                    transposed: Vec::new().into_iter(),
                    kept: keeps.then(|| Vec::with_capacity(self.parts().len())),
                }
            }
        };
        TransposedParts { index: self, table, source }
    }

    fn read_and_transpose(
        &self,
        group: Range<usize>,
        table: &RegionTable,
    ) -> Result<Vec<PartContributions>, ContributionError> {
        self.transpose(&self.read(group)?, table)
    }
}

impl Iterator for TransposedParts<'_> {
    type Item = Result<PartContributions, ContributionError>;

    fn next(&mut self) -> Option<Self::Item> {
        match &mut self.source {
            Source::Memory { parts, mask_counts } => {
                let mut part = parts.next()?.clone();
                weigh(&mut part, mask_counts);
                Some(Ok(part))
            }
            Source::Files { groups, transposed, kept } => {
                if transposed.len() == 0 {
                    let Some(group) = groups.next() else {
                        if let Some(kept) = kept.take() {
                            // Another pass may have kept them meanwhile: they are the same.
                            let _ = self.index.kept.set(kept);
                        }
                        return None;
                    };
                    match self.index.read_and_transpose(group, self.table) {
                        Ok(parts) => {
                            if let Some(kept) = kept {
                                kept.extend_from_slice(&parts);
                            }
                            *transposed = parts.into_iter();
                        }
                        Err(error) => {
                            (*groups, *kept) = (Vec::new().into_iter(), None);
                            return Some(Err(error));
                        }
                    }
                }
                transposed.next().map(Ok)
            }
        }
    }
}

/// Computes total weights, in the order in which transposing adds them: the bits are the same.
fn weigh(part: &mut PartContributions, mask_counts: &[f32]) {
    let PartContributions { starts, regions, weights, total_weights, .. } = part;
    total_weights.par_iter_mut().zip(starts.par_windows(2)).for_each(|(total, at)| {
        let entries = at[0] as usize..at[1] as usize;
        let mut sum = 0.0f64;
        for (region, weight) in regions[entries.clone()].iter().zip(&weights[entries]) {
            sum += f64::from(*weight) * f64::from(mask_counts[*region as usize]);
        }
        *total = sum as f32;
    });
}
