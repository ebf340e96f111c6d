//! The contribution files of all views, in the order of the views' names, and the parts that their entries form.
//!
//! Each view's file is ordered by cell and slice, so that any range of cells is one range of each file.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use rayon::prelude::*;

use super::contributions::{ContributionError, ContributionFile, GAUSSIANS_PER_SLICE, PackedEntry, Run};
use super::table::RegionTable;
use crate::cells::CellSplit;
use crate::memory::{MemoryPlan, Phase};

/// Most entries of a part. Not a share of the budget: parts are published, and a store must not depend on the memory of
/// the machine that made it.
pub(super) const PART_ENTRIES: u64 = 1 << 22;
/// Most entries of a transposed group, as many as a part's: larger ones leave the processor's caches.
const GROUP_ENTRIES: u64 = PART_ENTRIES;
/// Region and weight.
const BYTES_PER_TRANSPOSED_ENTRY: u64 = size_of::<(u32, f32)>() as u64;
/// As read, and transposed.
const BYTES_PER_ENTRY: u64 = size_of::<PackedEntry>() as u64 + BYTES_PER_TRANSPOSED_ENTRY;
/// Start, total weight, mean length, index.
const BYTES_PER_GAUSSIAN: u64 = (size_of::<u64>() + 3 * size_of::<f32>()) as u64;

/// Consecutive Gaussians of a cell: all, unless they have very many entries.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    pub cell_id: u32,
    pub number: u32,
    /// Indices within the cell.
    pub(crate) locals: Range<usize>,
    pub n_entries: u64,
    /// Numbered over the whole scene.
    pub(super) slices: Range<usize>,
}

impl Part {
    /// Scene indices of the part's Gaussians.
    pub fn gaussians<'a>(&self, split: &'a CellSplit) -> &'a [u32] {
        &split.cells[self.cell_id as usize].gaussians[self.locals.clone()]
    }
}

/// A part's contributions by Gaussian, in canonical order: views by name, then regions.
#[derive(Clone, Debug, PartialEq)]
pub struct PartContributions {
    pub part: Part,
    /// `[N + 1]`: start of each Gaussian's entries.
    pub starts: Vec<u64>,
    /// By entry, numbered over the whole scene.
    pub regions: Vec<u32>,
    pub weights: Vec<f32>,
    /// `[N]`: `Σ_r a(k, r) n_r`, the evidence.
    pub total_weights: Vec<f32>,
}

impl PartContributions {
    pub(super) fn zeroed(part: &Part) -> Self {
        let (n, n_entries) = (part.locals.len(), part.n_entries as usize);
        Self {
            part: part.clone(),
            starts: vec![0; n + 1],
            regions: vec![0; n_entries],
            weights: vec![0.0; n_entries],
            total_weights: vec![0.0; n],
        }
    }

    #[inline(always)]
    pub(crate) fn entries_of(&self, k: usize) -> Range<usize> {
        self.starts[k] as usize..self.starts[k + 1] as usize
    }

    /// Regions and weights of a Gaussian's entries.
    pub(super) fn entries(&self, k: usize) -> impl Iterator<Item = (u32, f32)> {
        let of = self.entries_of(k);
        self.regions[of.clone()].iter().copied().zip(self.weights[of].iter().copied())
    }
}

/// A view's file, and the position of its regions and runs in the scene.
#[derive(Debug)]
pub(crate) struct IndexedView {
    pub(crate) file: ContributionFile,
    /// Slice of each run, ascending.
    pub(super) slices: Vec<u32>,
    pub(crate) first_region: u32,
    pub(crate) n_masks: usize,
}

/// Ordered by the views' names.
pub struct ContributionIndex {
    pub(crate) views: Vec<IndexedView>,
    /// Ascending by cell and within it.
    pub parts: Vec<Part>,
    /// Gaussians of each slice: indices within its cell.
    pub(super) locals_of_slice: Vec<Range<usize>>,
    /// Transposed parts, if a pass has read them and the budget holds them.
    pub(super) kept: OnceLock<Vec<PartContributions>>,
}

/// Entries of a group of parts, in file order.
pub struct RawGroup {
    pub(super) parts: Range<usize>,
    /// By view: its runs, and their entries.
    pub(super) views: Vec<(Range<usize>, Vec<PackedEntry>)>,
}

impl ContributionIndex {
    /// Opens the files of all views, ordered by name, and collects their regions.
    /// `n_gaussians_of_cell`: by cell of the scene.
    pub fn open(
        paths: &[PathBuf],
        dim: usize,
        n_gaussians_of_cell: &[usize],
    ) -> Result<(Self, RegionTable), ContributionError> {
        Self::open_with(paths, dim, n_gaussians_of_cell, PART_ENTRIES)
    }

    /// With parts of at most `part_entries`.
    pub(super) fn open_with(
        paths: &[PathBuf],
        dim: usize,
        n_gaussians_of_cell: &[usize],
        part_entries: u64,
    ) -> Result<(Self, RegionTable), ContributionError> {
        let mut first_slice_of_cell = vec![0];
        let mut locals_of_slice = Vec::new();
        for n in n_gaussians_of_cell {
            let starts = (0..*n).step_by(GAUSSIANS_PER_SLICE);
            locals_of_slice.extend(starts.map(|start| start..(start + GAUSSIANS_PER_SLICE).min(*n)));
            first_slice_of_cell.push(locals_of_slice.len());
        }
        let mut table = RegionTable::new(dim);
        let mut views = Vec::with_capacity(paths.len());
        let mut entries_of_slice = vec![0u64; locals_of_slice.len()];
        for path in paths {
            let (file, regions) = ContributionFile::open(path)?;
            if regions.dim != dim {
                return Err(of_another_scene(path));
            }
            let first_region = table.append(&regions.mask_vectors, regions.masks_of_region())?;
            let slices = file.runs.iter().map(|run| {
                let of_cell = first_slice_of_cell.get(run.cell_id as usize..=run.cell_id as usize + 1)?;
                let slice = of_cell[0] + run.slice as usize;
                (slice < of_cell[1]).then_some(slice as u32)
            });
            let Some(slices) = slices.collect::<Option<Vec<u32>>>() else {
                return Err(of_another_scene(path));
            };
            for (run, slice) in slices.iter().enumerate() {
                let range = file.entries_of_run(run);
                entries_of_slice[*slice as usize] += range.end - range.start;
            }
            let n_masks = regions.mask_vectors.len() / dim;
            views.push(IndexedView { file, slices, first_region, n_masks });
        }
        let parts = first_slice_of_cell
            .windows(2)
            .enumerate()
            .flat_map(|(cell, w)| {
                cut_into_parts(cell as u32, w[0]..w[1], &entries_of_slice, &locals_of_slice, part_entries)
            })
            .collect();
        Ok((Self { views, parts, locals_of_slice, kept: OnceLock::new() }, table))
    }

    pub fn n_entries(&self) -> u64 {
        self.parts.iter().map(|part| part.n_entries).sum()
    }

    pub fn len_bytes(&self) -> u64 {
        let per_run = size_of::<Run>() + size_of::<u32>();
        let n_runs: usize = self.views.iter().map(|view| view.slices.len()).sum();
        (n_runs * per_run + self.parts.len() * size_of::<Part>() + size_of_val(&*self.locals_of_slice)) as u64
    }

    pub(crate) fn reserve(&self, memory: &mut MemoryPlan) {
        memory.reserve(Phase::Always, "the index of contributions", self.len_bytes());
    }

    /// Bytes of the largest part while it is transposed: the smallest budget.
    pub(crate) fn largest_part_bytes(&self) -> u64 {
        self.parts.iter().map(part_bytes).max().unwrap_or(0)
    }

    pub(super) fn kept_bytes(&self) -> u64 {
        let of_part = |part: &Part| {
            part.n_entries * BYTES_PER_TRANSPOSED_ENTRY + part.locals.len() as u64 * BYTES_PER_GAUSSIAN
        };
        self.parts.iter().map(of_part).sum()
    }

    /// Groups parts to at most `budget_bytes` each, or a single part. `n_largest`: how many of the largest parts a
    /// group may hold if the budget allows more.
    pub fn groups(&self, budget_bytes: u64, n_largest: u64) -> Vec<Range<usize>> {
        let max_entries = GROUP_ENTRIES.saturating_mul(n_largest);
        let mut groups: Vec<Range<usize>> = Vec::new();
        let (mut bytes, mut entries) = (0, 0);
        for (i, part) in self.parts.iter().enumerate() {
            bytes += part_bytes(part);
            entries += part.n_entries;
            match groups.last_mut() {
                Some(group) if bytes <= budget_bytes && entries <= max_entries => group.end = i + 1,
                _ => {
                    (bytes, entries) = (part_bytes(part), part.n_entries);
                    groups.push(i..i + 1);
                }
            }
        }
        groups
    }

    pub fn read(&self, parts: Range<usize>) -> Result<RawGroup, ContributionError> {
        let slices = self.slices_of(&parts);
        let runs_of = |view: &IndexedView| {
            let at = |slice: usize| view.slices.partition_point(|s| (*s as usize) < slice);
            at(slices.start)..at(slices.end)
        };
        let read = |view: &IndexedView| {
            let runs = runs_of(view);
            Ok((runs.clone(), view.file.read(runs)?))
        };
        let views = self.views.par_iter().map(read).collect::<Result<_, ContributionError>>()?;
        Ok(RawGroup { parts, views })
    }

    pub(super) fn slices_of(&self, parts: &Range<usize>) -> Range<usize> {
        let parts = &self.parts[parts.clone()];
        match (parts.first(), parts.last()) {
            (Some(first), Some(last)) => first.slices.start..last.slices.end,
            _ => 0..0,
        }
    }
}

fn of_another_scene(path: &Path) -> ContributionError {
    ContributionError::damaged(path, "the contributions belong to another scene or model".into())
}

fn part_bytes(part: &Part) -> u64 {
    part.n_entries * BYTES_PER_ENTRY + part.locals.len() as u64 * BYTES_PER_GAUSSIAN
}

/// Cuts a cell's slices into parts of at most `max_entries`, or of one slice.
fn cut_into_parts(
    cell_id: u32,
    slices: Range<usize>,
    entries_of_slice: &[u64],
    locals_of_slice: &[Range<usize>],
    max_entries: u64,
) -> Vec<Part> {
    let mut parts: Vec<Part> = Vec::new();
    for slice in slices {
        let (n_entries, locals) = (entries_of_slice[slice], locals_of_slice[slice].clone());
        match parts.last_mut() {
            Some(part) if part.n_entries + n_entries <= max_entries => {
                part.n_entries += n_entries;
                part.locals.end = locals.end;
                part.slices.end = slice + 1;
            }
            _ => {
                let number = parts.len() as u32;
                parts.push(Part { cell_id, number, locals, n_entries, slices: slice..slice + 1 });
            }
        }
    }
    parts
}

struct SliceTask<'a> {
    /// Numbers of views, and their entries.
    runs: Vec<(usize, &'a [PackedEntry])>,
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
                runs_of_slice[of_view.slices[run] as usize - first_slice].push((view, entries));
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
                let n_entries: usize = runs.iter().map(|(_, entries)| entries.len()).sum();
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
        let mask_counts = |view: &IndexedView| {
            let first = view.first_region as usize;
            table.mask_counts(first..first + view.file.n_regions)
        };
        let counts: Vec<Vec<f32>> = self.views.par_iter().map(mask_counts).collect();
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
        task.runs.iter().flat_map(|(_, entries)| *entries).for_each(|e| next[e.in_slice()] += 1);
        let mut at = 0;
        for (gaussian, next) in next.iter_mut().enumerate() {
            let n = std::mem::replace(next, at);
            at += n;
            match task.starts.get_mut(gaussian) {
                Some(end) => *end = task.first_entry + u64::from(at),
                None if n == 0 => {}
                None => {
                    let what =
                        format!("a contribution of Gaussian {gaussian} to a slice with fewer Gaussians");
                    return Err(ContributionError::damaged(&self.views[task.runs[0].0].file.path, what));
                }
            }
        }
        let mut totals = [0.0f64; GAUSSIANS_PER_SLICE];
        for (view, entries) in &task.runs {
            let (first_region, counts) = (self.views[*view].first_region, &mask_counts[*view]);
            for entry in *entries {
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
