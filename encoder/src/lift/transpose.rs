//! Brings the contributions of all views together by Gaussian, within a memory budget.
//!
//! Every view's file is ordered by cell and slice, so any stretch of cells is read from each file in
//! one piece. A group of parts that fits the budget is read, turned from views' order into Gaussians',
//! and used up before the next: no byte is read twice, none is written.

use std::ops::Range;
use std::path::PathBuf;

use rayon::prelude::*;
use slag_common::container::ContainerError;

use super::contributions::{ContributionError, ContributionFile, GAUSSIANS_PER_SLICE, PackedEntry};
use super::table::RegionTable;

/// Entries above which a cell is cut into parts. A constant, not a share of the budget: parts are
/// published, and a store must not depend on the memory of the machine that made it.
const PART_ENTRIES: u64 = 1 << 22;
/// Entries of a group where the budget would allow more: larger ones only leave the caches.
const GROUP_ENTRIES: u64 = 1 << 22;
/// Bytes that an entry takes while it is transposed: as read, and as region and weight.
const BYTES_PER_ENTRY: u64 = (size_of::<PackedEntry>() + size_of::<(u32, f32)>()) as u64;
/// Bytes that a Gaussian takes: start, total weight, mean length, index.
const BYTES_PER_GAUSSIAN: u64 = (size_of::<u64>() + 3 * size_of::<f32>()) as u64;

/// Some consecutive Gaussians of a cell: all, unless they have very many entries.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// The cell.
    pub cell_id: u32,
    /// Which of the cell's parts this is.
    pub number: u32,
    /// Its Gaussians, by their index within the cell.
    pub locals: Range<usize>,
    /// Its entries.
    pub n_entries: u64,
    /// Its slices, numbered over the whole scene.
    slices: Range<usize>,
}

/// The contributions of a part by Gaussian, in canonical order: views by name, then regions.
#[derive(Clone, Debug, PartialEq)]
pub struct PartContributions {
    /// Of which part.
    pub part: Part,
    /// `[N + 1]`: where each Gaussian's entries start.
    pub starts: Vec<u64>,
    /// Region of each entry, of the whole scene.
    pub regions: Vec<u32>,
    /// Sum of each entry.
    pub weights: Vec<f32>,
    /// `[N]`: `Σ_r a(k, r) n_r`, the evidence.
    pub total_weights: Vec<f32>,
}

/// A view's file, and what its numbers mean in the whole scene.
struct IndexedView {
    file: ContributionFile,
    /// Slice of each run, ascending.
    slices: Vec<u32>,
    first_region: u32,
    n_masks: usize,
}

/// The files of all views, in the order of the views' names.
pub struct ContributionIndex {
    views: Vec<IndexedView>,
    parts: Vec<Part>,
    /// The first Gaussian of each slice, by its index within its cell, and one beyond its last.
    locals_of_slice: Vec<Range<usize>>,
    n_views_without_masks: usize,
}

/// The entries of a group of parts, view by view as they lie in the files.
pub struct RawGroup {
    parts: Range<usize>,
    /// Of each view: the first of its runs, and the entries.
    views: Vec<(Range<usize>, Vec<PackedEntry>)>,
}

/// A slice's entries in one view.
#[derive(Clone, Copy)]
struct SliceRun<'a> {
    view: usize,
    entries: &'a [PackedEntry],
}

/// A slice to be transposed, and where its results go.
struct SliceTask<'a> {
    runs: Vec<SliceRun<'a>>,
    starts: &'a mut [u64],
    first_entry: u64,
    regions: &'a mut [u32],
    weights: &'a mut [f32],
    total_weights: &'a mut [f32],
}

impl ContributionIndex {
    /// Opens the files of all views, in the order of their names, of a scene with cells of
    /// `n_gaussians_of_cell` Gaussians, and gathers the regions of all.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn open(
        paths: &[PathBuf],
        dim: usize,
        n_gaussians_of_cell: &[usize],
    ) -> Result<(Self, RegionTable), ContributionError> {
        Self::open_with(paths, dim, n_gaussians_of_cell, PART_ENTRIES)
    }

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
        let mut n_views_without_masks = 0;
        let mut views = Vec::with_capacity(paths.len());
        let mut entries_of_slice = vec![0u64; locals_of_slice.len()];
        for path in paths {
            let (file, regions) = ContributionFile::open(path)?;
            let slices = file.runs().iter().map(|run| {
                let of_cell = first_slice_of_cell.get(run.cell_id as usize..=run.cell_id as usize + 1)?;
                let slice = of_cell[0] + run.slice as usize;
                (slice < of_cell[1]).then_some(slice as u32)
            });
            let Some(slices) = slices.collect::<Option<Vec<u32>>>().filter(|_| regions.dim == dim) else {
                let what = "the contributions are of another scene or model".into();
                let source = ContainerError::Damaged { offset_bytes: 0, what };
                return Err(ContributionError::Damaged { path: path.clone(), source });
            };
            for (run, slice) in slices.iter().enumerate() {
                let range = file.entries_of_run(run);
                entries_of_slice[*slice as usize] += range.end - range.start;
            }
            n_views_without_masks += usize::from(regions.mask_vectors.is_empty());
            let first_region = table.append(&regions.mask_vectors, regions.masks_of_region());
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
        Ok((Self { views, parts, locals_of_slice, n_views_without_masks }, table))
    }

    /// Returns the parts, ascending by cell and within it.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// Returns the number of entries of all views.
    pub fn n_entries(&self) -> u64 {
        self.parts.iter().map(|part| part.n_entries).sum()
    }

    /// Returns the first region of each view, in the order of their names.
    pub fn first_regions(&self) -> Vec<u32> {
        self.views.iter().map(|view| view.first_region).collect()
    }

    /// Returns the number of views without any mask.
    pub fn n_views_without_masks(&self) -> usize {
        self.n_views_without_masks
    }

    /// Returns the number of masks of each view.
    pub fn n_masks_of_view(&self) -> impl Iterator<Item = usize> + '_ {
        self.views.iter().map(|view| view.n_masks)
    }

    /// Returns the number of regions of each view.
    pub fn n_regions_of_view(&self) -> impl Iterator<Item = usize> + '_ {
        self.views.iter().map(|view| view.file.n_regions())
    }

    /// Returns the number of entries of each view.
    pub fn n_entries_of_view(&self) -> impl Iterator<Item = u64> + '_ {
        self.views.iter().map(|view| view.file.n_entries())
    }

    /// Returns the bytes that the index takes in memory.
    pub fn len_bytes(&self) -> u64 {
        let per_run = size_of::<super::contributions::Run>() + size_of::<u32>();
        let n_runs: usize = self.views.iter().map(|view| view.slices.len()).sum();
        (n_runs * per_run + self.parts.len() * size_of::<Part>() + size_of_val(&*self.locals_of_slice)) as u64
    }

    /// Returns the bytes that the largest part takes while it is transposed: the least budget.
    pub fn largest_part_bytes(&self) -> u64 {
        self.parts.iter().map(part_bytes).max().unwrap_or(0)
    }

    /// Cuts the parts into groups that take at most `budget_bytes` each, or are a single part.
    pub fn groups(&self, budget_bytes: u64) -> Vec<Range<usize>> {
        let mut groups: Vec<Range<usize>> = Vec::new();
        let (mut bytes, mut entries) = (0, 0);
        for (i, part) in self.parts.iter().enumerate() {
            bytes += part_bytes(part);
            entries += part.n_entries;
            match groups.last_mut() {
                Some(group) if bytes <= budget_bytes && entries <= GROUP_ENTRIES => group.end = i + 1,
                _ => {
                    (bytes, entries) = (part_bytes(part), part.n_entries);
                    groups.push(i..i + 1);
                }
            }
        }
        groups
    }

    /// Reads and checks the entries of some parts.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn read(&self, parts: Range<usize>) -> Result<RawGroup, ContributionError> {
        let slices = self.slices_of(&parts);
        let read = |view: &IndexedView| {
            let at = |slice: usize| view.slices.partition_point(|s| (*s as usize) < slice);
            let runs = at(slices.start)..at(slices.end);
            Ok((runs.clone(), view.file.read(runs)?))
        };
        let views = self.views.par_iter().map(read).collect::<Result<_, ContributionError>>()?;
        Ok(RawGroup { parts, views })
    }

    fn slices_of(&self, parts: &Range<usize>) -> Range<usize> {
        let parts = &self.parts[parts.clone()];
        match (parts.first(), parts.last()) {
            (Some(first), Some(last)) => first.slices.start..last.slices.end,
            _ => 0..0,
        }
    }

    /// Turns the entries of a group from views' order into Gaussians'.
    ///
    /// # Errors
    /// [`ContributionError::Damaged`] for an entry of a Gaussian that its slice does not have.
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
            self.parts[raw.parts.clone()].iter().map(PartContributions::empty).collect();
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

    /// A counting sort by Gaussian that keeps the order of the views.
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
        table.mask_counts(first..first + self.file.n_regions())
    }

    fn foreign_gaussian(&self, in_slice: usize) -> ContributionError {
        let what = format!("a sum of Gaussian {in_slice} of a slice that has fewer");
        ContributionError::Damaged {
            path: self.file.path().to_owned(),
            source: ContainerError::Damaged { offset_bytes: 0, what },
        }
    }
}

impl PartContributions {
    fn empty(part: &Part) -> Self {
        let (n, n_entries) = (part.locals.len(), part.n_entries as usize);
        Self {
            part: part.clone(),
            starts: vec![0; n + 1],
            regions: vec![0; n_entries],
            weights: vec![0.0; n_entries],
            total_weights: vec![0.0; n],
        }
    }
}

fn part_bytes(part: &Part) -> u64 {
    part.n_entries * BYTES_PER_ENTRY + part.locals.len() as u64 * BYTES_PER_GAUSSIAN
}

/// Cuts a cell's slices into parts of at most `max_entries`, or of a single slice.
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
