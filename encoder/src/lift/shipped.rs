//! The index of all views in one file, for machines that read contributions by byte ranges from a bucket and have none of
//! the views' files.

use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::contributions::{ContributionError, ContributionFile, Run};
use super::index::{ContributionIndex, IndexedView, PART_ENTRIES, RangeReader};

const MAGIC: [u8; 8] = *b"SLAGCIDX";
const VERSION: u32 = 1;

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct ViewRow {
    n_regions: u32,
    n_masks: u32,
    first_region: u32,
    n_runs: u32,
    n_entries: u64,
    entries_at_bytes: u64,
}

impl ContributionIndex {
    /// Writes the index.
    ///
    /// # Errors
    /// Errors of the writer.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let row = |view: &IndexedView| ViewRow {
            n_regions: view.file.n_regions() as u32,
            n_masks: view.n_masks as u32,
            first_region: view.first_region,
            n_runs: view.file.runs().len() as u32,
            n_entries: view.file.n_entries(),
            entries_at_bytes: view.file.entries_at_bytes,
        };
        let rows: Vec<ViewRow> = self.views.iter().map(row).collect();
        let runs: Vec<Run> = self.views.iter().flat_map(|view| view.file.runs()).copied().collect();
        let counts = [rows.len() as u64, runs.len() as u64];
        let sections = [
            (1, bytemuck::bytes_of(&counts)),
            (2, container::bytes_of(&rows)),
            (3, container::bytes_of(&runs)),
        ];
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Reads an index. `names`: of the views' files, in their order, for errors; `reader`: reads these files;
    /// `n_gaussians_of_cell`: of the scene.
    ///
    /// # Errors
    /// [`ContributionError::Damaged`] if the index is damaged, or belongs to other views or cells.
    pub fn read_shipped(
        bytes: &AlignedBytes,
        names: Vec<PathBuf>,
        reader: Arc<dyn RangeReader>,
        n_gaussians_of_cell: &[usize],
    ) -> Result<Self, ContributionError> {
        let name = PathBuf::from("the index of contributions");
        let damaged = |source| ContributionError::Damaged { path: name.clone(), source };
        let layout = Layout::check(bytes, MAGIC, VERSION).map_err(damaged)?;
        let [n_views, n_runs] = layout
            .value::<[u64; 2]>(bytes, 1, "counts")
            .map_err(damaged)?
            .map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let rows = layout.column::<ViewRow>(2, "views", n_views).map_err(damaged)?;
        let rows: Vec<ViewRow> = bytemuck::pod_collect_to_vec(&bytes[rows]);
        let runs = layout.column::<Run>(3, "runs", n_runs).map_err(damaged)?;
        let runs: Vec<Run> = bytemuck::pod_collect_to_vec(&bytes[runs]);
        let of_rows = rows.iter().try_fold(0usize, |sum, row| sum.checked_add(row.n_runs as usize));
        let mut left = &runs[..];
        let mut files = Vec::with_capacity(rows.len());
        if rows.len() != names.len() || of_rows != Some(runs.len()) {
            let what = format!("{} views of {n_runs} runs, expected {} views", rows.len(), names.len());
            return Err(damaged(ContainerError::Damaged { offset_bytes: 0, what }));
        }
        for (row, path) in rows.into_iter().zip(names) {
            let (of_view, rest) = left.split_at(row.n_runs as usize);
            left = rest;
            let is_valid = of_view
                .is_sorted_by(|a, b| (a.cell_id, a.slice) < (b.cell_id, b.slice) && a.start <= b.start)
                && of_view.first().map_or(row.n_entries, |run| run.start) == 0
                && of_view.last().is_none_or(|run| run.start <= row.n_entries);
            if !is_valid {
                let what = format!("runs of {} out of order", path.display());
                return Err(damaged(ContainerError::Damaged { offset_bytes: 0, what }));
            }
            let file = ContributionFile {
                path,
                n_regions: row.n_regions as usize,
                n_entries: row.n_entries,
                entries_at_bytes: row.entries_at_bytes,
                runs: of_view.to_vec(),
            };
            files.push((file, row.first_region, row.n_masks as usize));
        }
        let mut index = Self::of_files(files, n_gaussians_of_cell, PART_ENTRIES)?;
        index.elsewhere = Some(reader);
        Ok(index)
    }
}
