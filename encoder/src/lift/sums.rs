//! What one view contributes: its mask vectors, its regions, and the sparse sums, in a file of the
//! job's folder, so that a killed encode does not compute them again.

use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::buckets::SumEntry;
use crate::raster::RegionWeight;
use crate::shard::cells::{CellSplit, NO_CELL};

const MAGIC: [u8; 8] = *b"SLAGSUMS";
const VERSION: u32 = 1;

mod section {
    pub const HEADER: u32 = 1;
    pub const REGION_STARTS: u32 = 2;
    pub const REGION_MASKS: u32 = 3;
    pub const MASK_VECTORS: u32 = 4;
    pub const CELLS: u32 = 5;
    pub const ENTRIES: u32 = 6;
}

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Header {
    n_regions: u32,
    n_masks: u32,
    dim: u32,
    n_cells: u32,
    n_region_masks: u64,
    n_entries: u64,
}

/// The entries of one cell: those from `start` on, up to the next cell's.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct CellStart {
    cell_id: u32,
    padding: u32,
    start: u64,
}

/// One view's part of the lift.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSums {
    /// Components of a mask vector.
    pub dim: usize,
    /// `[n_masks][dim]`, unit.
    pub mask_vectors: Vec<f32>,
    /// The masks that cover each region, ascending.
    pub masks_of_region: Vec<Vec<u32>>,
    /// Sums by cell (ascending), within a cell by (Gaussian, region); regions are the view's own.
    pub entries_of_cell: Vec<(u32, Vec<SumEntry>)>,
}

/// A file of sums that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SumsError {
    /// The file system said no.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The file is damaged.
    #[error("{}: {source}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: ContainerError,
    },
}

impl ViewSums {
    /// Groups a view's weights by cell. `weights` are sorted by (Gaussian, region).
    pub fn new(
        weights: &[RegionWeight],
        masks_of_region: Vec<Vec<u32>>,
        mask_vectors: Vec<f32>,
        dim: usize,
        split: &CellSplit,
    ) -> Self {
        let mut keyed: Vec<(u32, SumEntry)> = weights
            .iter()
            .filter(|w| split.cell_of_gaussian[w.gaussian as usize] != NO_CELL)
            .map(|w| {
                let local = split.local_of_gaussian[w.gaussian as usize];
                let entry = SumEntry { local, region: w.region, weight: w.weight };
                (split.cell_of_gaussian[w.gaussian as usize], entry)
            })
            .collect();
        keyed.sort_unstable_by_key(|(cell, e)| (*cell, e.local, e.region));
        let entries_of_cell = keyed
            .chunk_by(|a, b| a.0 == b.0)
            .map(|run| (run[0].0, run.iter().map(|(_, entry)| *entry).collect()))
            .collect();
        Self { dim, mask_vectors, masks_of_region, entries_of_cell }
    }

    /// Writes the file durably: a temporary name, fsync, rename, fsync of the folder.
    ///
    /// # Errors
    /// [`SumsError::Io`].
    pub fn write(&self, path: &Path) -> Result<(), SumsError> {
        let mut region_starts = vec![0u32];
        let mut region_masks: Vec<u32> = Vec::new();
        for masks in &self.masks_of_region {
            region_masks.extend(masks);
            region_starts.push(region_masks.len() as u32);
        }
        let mut cells = Vec::new();
        let mut entries: Vec<SumEntry> = Vec::new();
        for (cell_id, of_cell) in &self.entries_of_cell {
            cells.push(CellStart { cell_id: *cell_id, padding: 0, start: entries.len() as u64 });
            entries.extend(of_cell);
        }
        let header = Header {
            n_regions: self.masks_of_region.len() as u32,
            n_masks: (self.mask_vectors.len() / self.dim) as u32,
            dim: self.dim as u32,
            n_cells: cells.len() as u32,
            n_region_masks: region_masks.len() as u64,
            n_entries: entries.len() as u64,
        };
        let sections = [
            (section::HEADER, bytemuck::bytes_of(&header)),
            (section::REGION_STARTS, container::bytes_of(&region_starts)),
            (section::REGION_MASKS, container::bytes_of(&region_masks)),
            (section::MASK_VECTORS, container::bytes_of(&self.mask_vectors)),
            (section::CELLS, container::bytes_of(&cells)),
            (section::ENTRIES, container::bytes_of(&entries)),
        ];
        let mut bytes = Vec::new();
        container::write(&mut bytes, MAGIC, VERSION, &sections)?;
        Ok(crate::store::write_durably(path, &bytes)?)
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`SumsError`].
    pub fn read(path: &Path) -> Result<Self, SumsError> {
        let bytes = AlignedBytes::read(path)?;
        Self::parse(&bytes).map_err(|source| SumsError::Damaged { path: path.to_owned(), source })
    }

    fn parse(bytes: &[u8]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let header: Header = layout.value(bytes, section::HEADER, "header")?;
        let (n_regions, n_masks, dim) =
            (header.n_regions as usize, header.n_masks as usize, header.dim as usize);
        let n_entries = header.n_entries as usize;
        let starts: Vec<u32> =
            column(bytes, &layout, section::REGION_STARTS, "region starts", n_regions + 1)?;
        let masks: Vec<u32> =
            column(bytes, &layout, section::REGION_MASKS, "region masks", header.n_region_masks as usize)?;
        let mask_vectors =
            column(bytes, &layout, section::MASK_VECTORS, "mask vectors", n_masks.saturating_mul(dim))?;
        let cells: Vec<CellStart> = column(bytes, &layout, section::CELLS, "cells", header.n_cells as usize)?;
        let entries: Vec<SumEntry> = column(bytes, &layout, section::ENTRIES, "entries", n_entries)?;
        let consistent = dim > 0
            && starts.windows(2).all(|w| w[0] <= w[1])
            && starts[0] == 0
            && starts[n_regions] as usize == masks.len()
            && masks.iter().all(|m| (*m as usize) < n_masks)
            && cells.windows(2).all(|w| w[0].cell_id < w[1].cell_id && w[0].start <= w[1].start)
            && cells.iter().all(|c| c.start as usize <= n_entries)
            && entries.iter().all(|e| (e.region as usize) < n_regions && e.weight.is_finite());
        if !consistent {
            let what = "regions, masks, cells or entries refer to what is not there".into();
            return Err(ContainerError::Damaged { offset_bytes: 0, what });
        }
        let masks_of_region =
            starts.windows(2).map(|w| masks[w[0] as usize..w[1] as usize].to_vec()).collect();
        let ends = cells.iter().skip(1).map(|c| c.start as usize).chain([n_entries]);
        let entries_of_cell = cells
            .iter()
            .zip(ends)
            .map(|(c, end)| (c.cell_id, entries[c.start as usize..end].to_vec()))
            .collect();
        Ok(Self { dim, mask_vectors, masks_of_region, entries_of_cell })
    }
}

fn column<T: bytemuck::Pod>(
    bytes: &[u8],
    layout: &Layout,
    id: u32,
    name: &'static str,
    len: usize,
) -> Result<Vec<T>, ContainerError> {
    Ok(bytemuck::pod_collect_to_vec(&bytes[layout.column::<T>(id, name, len)?]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_trip_groups_by_cell_and_refuses_damage() {
        let split = CellSplit {
            cells: Vec::new(),
            cell_of_gaussian: vec![1, 0, 1, NO_CELL],
            local_of_gaussian: vec![1, 0, 0, 0],
            n_rejected: 1,
        };
        let weight = |gaussian, region| RegionWeight { gaussian, region, weight: (gaussian + region) as f32 };
        let weights = [weight(0, 0), weight(0, 1), weight(1, 1), weight(2, 0), weight(3, 0)];
        let sums = ViewSums::new(&weights, vec![vec![0], vec![0, 1]], vec![1.0, 0.0, 0.0, 1.0], 2, &split);
        let entry = |local, region, weight| SumEntry { local, region, weight };
        assert_eq!(
            sums.entries_of_cell,
            [(0, vec![entry(0, 1, 2.0)]), (1, vec![entry(0, 0, 2.0), entry(1, 0, 0.0), entry(1, 1, 1.0)])]
        );
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("v.sums");
        sums.write(&path).expect("writes");
        assert_eq!(ViewSums::read(&path).expect("reads"), sums);
        let bytes = fs_err::read(&path).expect("reads");
        fs_err::write(&path, &bytes[..bytes.len() - 64]).expect("writes");
        assert!(ViewSums::read(&path).expect_err("cut").to_string().contains("v.sums"));
    }
}
