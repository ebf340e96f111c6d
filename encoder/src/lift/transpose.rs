//! Brings the contributions of all views together by Gaussian: each group of parts is transposed from the views'
//! order to the Gaussians'.

use rayon::prelude::*;
use slag_common::container::ContainerError;

use super::contributions::{ContributionError, GAUSSIANS_PER_SLICE, PackedEntry};
use super::index::{ContributionIndex, IndexedView, PartContributions, RawGroup};
use super::table::RegionTable;

#[derive(Clone, Copy)]
struct SliceRun<'a> {
    view: usize,
    entries: &'a [PackedEntry],
}

struct SliceTask<'a> {
    runs: Vec<SliceRun<'a>>,
    starts: &'a mut [u64],
    first_entry: u64,
    regions: &'a mut [u32],
    weights: &'a mut [f32],
    total_weights: &'a mut [f32],
}

impl ContributionIndex {
    pub fn transpose(
        &self,
        raw: &RawGroup,
        table: &RegionTable,
    ) -> Result<Vec<PartContributions>, ContributionError> {
        let first_slice = self.slices_of(&raw.parts).start;
        let mut runs_of_slice = vec![Vec::new(); self.slices_of(&raw.parts).len()];
        for (view, (runs, entries)) in raw.views.iter().enumerate() {
            let of_view = &self.views[view];
            let base = if runs.is_empty() { 0 } else { of_view.file.entries_of_run(runs.start).start };
            for run in runs.clone() {
                let range = of_view.file.entries_of_run(run);
                let entries = &entries[(range.start - base) as usize..(range.end - base) as usize];
                runs_of_slice[of_view.slices[run] as usize - first_slice].push(SliceRun { view, entries });
            }
        }
        let mut contributions: Vec<PartContributions> =
            self.parts[raw.parts.clone()].iter().map(PartContributions::zeroed).collect();
        let mut tasks = Vec::with_capacity(runs_of_slice.len());
        let mut runs_of_slice = runs_of_slice.into_iter();
        for contributions in &mut contributions {
            let (mut starts, mut totals) =
                (&mut contributions.starts[1..], &mut contributions.total_weights[..]);
            let (mut regions, mut weights) = (&mut contributions.regions[..], &mut contributions.weights[..]);
            let mut first_entry = 0;
            for slice in contributions.part.slices.clone() {
                let runs = runs_of_slice.next().unwrap_or_default();
                let n_entries: usize = runs.iter().map(|run| run.entries.len()).sum();
                let n = self.locals_of_slice[slice].len();
                let task = SliceTask {
                    runs,
                    first_entry,
                    starts: starts.split_off_mut(..n).unwrap_or_default(),
                    regions: regions.split_off_mut(..n_entries).unwrap_or_default(),
                    weights: weights.split_off_mut(..n_entries).unwrap_or_default(),
                    total_weights: totals.split_off_mut(..n).unwrap_or_default(),
                };
                first_entry += n_entries as u64;
                tasks.push(task);
            }
        }
        let counts: Vec<Vec<f32>> = self.views.par_iter().map(|view| view.mask_counts(table)).collect();
        tasks.into_par_iter().try_for_each(|task| self.transpose_slice(task, &counts))?;
        Ok(contributions)
    }

    /// Counting sort by Gaussian that keeps the views' order.
    fn transpose_slice(
        &self,
        task: SliceTask<'_>,
        mask_counts: &[Vec<f32>],
    ) -> Result<(), ContributionError> {
        let mut next = [0u32; GAUSSIANS_PER_SLICE];
        for run in &task.runs {
            run.entries.iter().for_each(|e| next[e.in_slice()] += 1);
        }
        let mut at = 0;
        for (gaussian, next) in next.iter_mut().enumerate() {
            let n = std::mem::replace(next, at);
            at += n;
            match task.starts.get_mut(gaussian) {
                Some(end) => *end = task.first_entry + u64::from(at),
                None if n == 0 => {}
                None => return Err(self.views[task.runs[0].view].foreign_gaussian(gaussian)),
            }
        }
        let mut totals = [0.0f64; GAUSSIANS_PER_SLICE];
        for run in &task.runs {
            let (first_region, counts) = (self.views[run.view].first_region, &mask_counts[run.view]);
            for entry in run.entries {
                let at = &mut next[entry.in_slice()];
                task.regions[*at as usize] = first_region + entry.region();
                task.weights[*at as usize] = entry.weight;
                *at += 1;
                totals[entry.in_slice()] +=
                    f64::from(entry.weight) * f64::from(counts[entry.region() as usize]);
            }
        }
        task.total_weights.iter_mut().zip(totals).for_each(|(out, total)| *out = total as f32);
        Ok(())
    }
}

impl IndexedView {
    fn mask_counts(&self, table: &RegionTable) -> Vec<f32> {
        let first = self.first_region as usize;
        table.mask_counts(first..first + self.file.n_regions)
    }

    fn foreign_gaussian(&self, in_slice: usize) -> ContributionError {
        let what = format!("a contribution of Gaussian {in_slice} to a slice with fewer Gaussians");
        ContributionError::Damaged {
            path: self.file.path.clone(),
            source: ContainerError::Damaged { offset_bytes: 0, what },
        }
    }
}
