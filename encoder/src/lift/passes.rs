//! A pass over the contributions of all parts. The lift, its refinements and the objects need several: where the
//! budget holds all parts, the first pass keeps them and later passes read no file.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use slag_common::Gaussians;

use super::contributions::ContributionError;
use super::index::{ContributionIndex, PartContributions};
use super::photos::Photo;
use super::table::RegionTable;
use crate::cells::CellSplit;
use crate::ground::Standing;

#[derive(Clone, Copy)]
pub(crate) struct SceneContributions<'a> {
    pub index: &'a ContributionIndex,
    pub gaussians: &'a Gaussians,
    pub split: &'a CellSplit,
    pub standing: &'a Standing,
    /// Masks of each view, in the index's order.
    pub photos: &'a [Photo],
    /// Budget for the contributions of a group of parts.
    pub(crate) group_bytes: u64,
    pub cancel: &'a AtomicBool,
}

impl SceneContributions<'_> {
    pub(crate) fn check_cancelled(&self) -> Result<(), ContributionError> {
        if self.cancel.load(Ordering::Relaxed) { Err(ContributionError::Cancelled) } else { Ok(()) }
    }

    /// Calls `work` for each part on all threads, and `merge` with the results in the order of parts.
    pub(super) fn visit<T: Send>(
        &self,
        table: &RegionTable,
        work: impl Fn(PartContributions) -> T + Sync,
        mut merge: impl FnMut(T),
    ) -> Result<(), ContributionError> {
        for group in self.index.transposed_groups(table, self.group_bytes) {
            self.check_cancelled()?;
            let results: Vec<T> = group?.into_par_iter().map(&work).collect();
            results.into_iter().for_each(&mut merge);
        }
        Ok(())
    }
}

/// A pass over transposed contributions, by group, in the order of [`ContributionIndex::parts`].
pub(super) struct TransposedGroups<'a> {
    index: &'a ContributionIndex,
    table: &'a RegionTable,
    groups: std::vec::IntoIter<Range<usize>>,
    source: Source<'a>,
}

enum Source<'a> {
    Files {
        /// Copies of the parts so far, if they are to be kept.
        kept: Option<Vec<PartContributions>>,
    },
    Memory {
        parts: &'a [PartContributions],
        /// `[n_regions]`: summed weight of the region's masks.
        mask_counts: Vec<f32>,
    },
}

impl ContributionIndex {
    /// Budget of a pass: enough to keep all parts if that fits, else half.
    pub(crate) fn budget_bytes(&self, budget_bytes: u64) -> u64 {
        let to_keep_bytes = self.kept_bytes().saturating_add(self.largest_part_bytes()).saturating_mul(2);
        let wanted_bytes = if to_keep_bytes <= budget_bytes { to_keep_bytes } else { budget_bytes / 2 };
        wanted_bytes.max(self.largest_part_bytes())
    }

    /// Starts a pass within `budget_bytes`, or the largest part's need. Total weights follow the table's present
    /// weights of masks. A group is what all threads work on at a time.
    pub(super) fn transposed_groups<'a>(
        &'a self,
        table: &'a RegionTable,
        budget_bytes: u64,
    ) -> TransposedGroups<'a> {
        let n_threads = rayon::current_num_threads() as u64;
        let (groups, source) = match self.kept.get() {
            Some(parts) => {
                let mask_counts = table.mask_counts(0..table.len());
                let for_groups = budget_bytes.saturating_sub(self.kept_bytes());
                (self.groups(for_groups, n_threads), Source::Memory { parts, mask_counts })
            }
            None => {
                // Half the budget: refinement and objects build lists of their own, which also grow with the entries.
                let keeps = self.kept_bytes().saturating_add(self.largest_part_bytes()) <= budget_bytes / 2;
                let for_groups = if keeps { budget_bytes - self.kept_bytes() } else { budget_bytes };
                let kept = keeps.then(|| Vec::with_capacity(self.parts.len()));
                (self.groups(for_groups, 1), Source::Files { kept })
            }
        };
        TransposedGroups { index: self, table, groups: groups.into_iter(), source }
    }

    /// Like [`Self::transposed_groups`], one part at a time.
    pub(crate) fn transposed_parts<'a>(
        &'a self,
        table: &'a RegionTable,
        budget_bytes: u64,
    ) -> impl Iterator<Item = Result<PartContributions, ContributionError>> + 'a {
        let mut groups = self.transposed_groups(table, budget_bytes);
        if let Source::Memory { parts, .. } = &groups.source {
            groups.groups = (0..parts.len()).map(|i| i..i + 1).collect::<Vec<_>>().into_iter();
        }
        groups.flat_map(|group| match group {
            Ok(parts) => parts.into_iter().map(Ok).collect(),
            Err(error) => vec![Err(error)],
        })
    }
}

impl Iterator for TransposedGroups<'_> {
    type Item = Result<Vec<PartContributions>, ContributionError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Self { index, table, groups, source } = self;
        let group = groups.next();
        match source {
            Source::Memory { parts, mask_counts } => {
                let weighed = |part: &PartContributions| {
                    let mut part = part.clone();
                    weigh(&mut part, mask_counts);
                    part
                };
                Some(Ok(parts[group?].par_iter().map(weighed).collect()))
            }
            Source::Files { kept } => {
                let Some(group) = group else {
                    if let Some(kept) = kept.take() {
                        // Another pass may have kept the same meanwhile.
                        let _ = index.kept.set(kept);
                    }
                    return None;
                };
                let read = index.read(group).and_then(|raw| index.transpose(&raw, table));
                match (&read, &mut *kept) {
                    (Ok(parts), Some(kept)) => kept.par_extend(parts.par_iter().cloned()),
                    (Ok(_), None) => {}
                    (Err(_), _) => (*groups, *kept) = (Vec::new().into_iter(), None),
                }
                Some(read)
            }
        }
    }
}

/// Total weights, summed in the order of transposing: the bits are the same.
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
