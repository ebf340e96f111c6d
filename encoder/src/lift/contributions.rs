//! A view's mask vectors, regions and sparse contributions, in a file of the job's folder: a killed encode does
//! not compute them again.
//!
//! The file starts with a container that holds all but the contributions. These follow it, ordered by (cell, slice
//! of its Gaussians): the contributions of consecutive cells are one range of the file, so a pass over all cells
//! reads each byte once.

use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use crate::cells::{CellSplit, NO_CELL};
use crate::raster::RegionWeight;
use crate::store::io_help;

const MAGIC: [u8; 8] = *b"SLAGCONT";
const VERSION: u32 = 2;
const REGION_BITS: u32 = 20;

/// Contributions of one slice from all views fit a core's cache.
pub(crate) const GAUSSIANS_PER_SLICE: usize = 1 << (32 - REGION_BITS);
/// Most regions, or masks, of all views and mixtures together.
pub(crate) const MAX_IN_ALL: usize = u32::MAX as usize - 1;
pub(crate) const MAX_REGIONS: usize = 1 << REGION_BITS;

/// Number of the section after the container, for errors.
const ENTRIES: u32 = 6;

#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Header {
    n_regions: u32,
    n_masks: u32,
    dim: u32,
    n_runs: u32,
    n_region_masks: u64,
    n_entries: u64,
}

/// Contributions of one slice of a cell, up to the start of the next run.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Run {
    pub cell_id: u32,
    /// Index within the cell / [`GAUSSIANS_PER_SLICE`].
    pub(crate) slice: u32,
    pub start: u64,
    /// CRC-32 of the entries.
    checksum: u64,
}

/// A contribution `a(k, r)`: the blending weight of a Gaussian, summed over the pixels of a region.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contribution {
    /// Index of the Gaussian within its cell.
    pub local: u32,
    pub region: u32,
    pub weight: f32,
}

/// A [`Contribution`] of a known slice, as in the file.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct PackedEntry {
    key: u32,
    pub(super) weight: f32,
}

impl PackedEntry {
    fn new(entry: &Contribution) -> Self {
        let in_slice = entry.local % GAUSSIANS_PER_SLICE as u32;
        Self { key: in_slice << REGION_BITS | entry.region, weight: entry.weight }
    }

    pub(super) fn in_slice(self) -> usize {
        (self.key >> REGION_BITS) as usize
    }

    pub(super) fn region(self) -> u32 {
        self.key & (MAX_REGIONS as u32 - 1)
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct ViewContributions {
    pub dim: usize,
    /// `[n_masks][dim]`, unit.
    pub mask_vectors: Vec<f32>,
    /// The masks that cover each region, ascending.
    pub masks_of_region: Vec<Vec<u32>>,
    /// Contributions by cell, ascending; within a cell by (Gaussian, region).
    pub entries_of_cell: Vec<(u32, Vec<Contribution>)>,
}

#[derive(Debug, thiserror::Error)]
pub enum ContributionError {
    #[error("{0}; {help}", help = io_help(.0))]
    Io(#[from] std::io::Error),
    #[error("{}: {source}", path.display())]
    Damaged { path: PathBuf, source: ContainerError },
    #[error("interrupted")]
    Cancelled,
    #[error(
        "more than {MAX_IN_ALL} {what} in all views; use fewer views (--views-limit) or fewer masks (--min-mask-px)"
    )]
    TooManyInAll { what: &'static str },
    #[error("{}: {found} regions, the limit is {MAX_REGIONS}; give fewer masks or a lower --raster-width", path.display())]
    TooManyRegions { path: PathBuf, found: usize },
}

impl ContributionError {
    pub(super) fn damaged(path: &Path, what: String) -> Self {
        let source = ContainerError::Damaged { offset_bytes: 0, what };
        Self::Damaged { path: path.to_owned(), source }
    }
}

/// CRC-32: for a gigabyte per scene a cryptographic hash would be the lift's slowest step. Storage and network have
/// checksums of their own.
fn checksum(entries: &[PackedEntry]) -> u64 {
    u64::from(crc32fast::hash(bytemuck::cast_slice(entries)))
}

impl ViewContributions {
    /// Groups a view's weights, sorted by (Gaussian, region), by cell.
    pub fn new(
        weights: &[RegionWeight],
        masks_of_region: Vec<Vec<u32>>,
        mask_vectors: Vec<f32>,
        dim: usize,
        split: &CellSplit,
    ) -> Self {
        let mut keyed: Vec<(u32, Contribution)> = weights
            .iter()
            .filter(|w| split.cell_of_gaussian[w.gaussian as usize] != NO_CELL)
            .map(|w| {
                let local = split.local_of_gaussian[w.gaussian as usize];
                let entry = Contribution { local, region: w.region, weight: w.weight };
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
    pub fn write(&self, path: &Path) -> Result<(), ContributionError> {
        Ok(slag_common::durable::write(path, &self.to_bytes(path)?)?)
    }

    /// `path`: its name, for errors.
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>, ContributionError> {
        let found = self.masks_of_region.len();
        if found > MAX_REGIONS {
            return Err(ContributionError::TooManyRegions { path: path.to_owned(), found });
        }
        let mut region_starts = vec![0u32];
        let mut region_masks: Vec<u32> = Vec::new();
        for masks in &self.masks_of_region {
            region_masks.extend(masks);
            region_starts.push(region_masks.len() as u32);
        }
        let mut runs = Vec::new();
        let mut entries: Vec<PackedEntry> = Vec::new();
        for (cell_id, of_cell) in &self.entries_of_cell {
            let slice = |e: &Contribution| e.local / GAUSSIANS_PER_SLICE as u32;
            for of_slice in of_cell.chunk_by(|a, b| slice(a) == slice(b)) {
                let start = entries.len();
                entries.extend(of_slice.iter().map(PackedEntry::new));
                let checksum = checksum(&entries[start..]);
                runs.push(Run {
                    cell_id: *cell_id,
                    slice: slice(&of_slice[0]),
                    start: start as u64,
                    checksum,
                });
            }
        }
        let header = Header {
            n_regions: self.masks_of_region.len() as u32,
            n_masks: (self.mask_vectors.len() / self.dim) as u32,
            dim: self.dim as u32,
            n_runs: runs.len() as u32,
            n_region_masks: region_masks.len() as u64,
            n_entries: entries.len() as u64,
        };
        let sections = [
            (1, bytemuck::bytes_of(&header)),
            (2, container::bytes_of(&region_starts)),
            (3, container::bytes_of(&region_masks)),
            (4, container::bytes_of(&self.mask_vectors)),
            (5, container::bytes_of(&runs)),
        ];
        let mut bytes = Vec::new();
        container::write(&mut bytes, MAGIC, VERSION, &sections)?;
        bytes.extend(container::bytes_of(&entries));
        Ok(bytes)
    }
}

/// A contribution file; its entries are checked on reading, the rest on opening.
#[derive(Clone, Debug)]
pub struct ContributionFile {
    pub(super) path: PathBuf,
    pub(crate) n_regions: usize,
    pub(crate) n_entries: u64,
    entries_at_bytes: u64,
    /// By (cell, slice), ascending.
    pub runs: Vec<Run>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct ViewRegions {
    pub dim: usize,
    /// `[n_masks][dim]`, unit.
    pub mask_vectors: Vec<f32>,
    starts: Vec<u32>,
    masks: Vec<u32>,
}

impl ViewRegions {
    pub fn masks_of_region(&self) -> impl ExactSizeIterator<Item = &[u32]> {
        self.starts.windows(2).map(|w| &self.masks[w[0] as usize..w[1] as usize])
    }
}

impl ContributionFile {
    /// Opens a file and checks everything but its entries.
    pub fn open(path: &Path) -> Result<(Self, ViewRegions), ContributionError> {
        let damaged = |source| ContributionError::Damaged { path: path.to_owned(), source };
        let mut file = fs_err::File::open(path)?;
        let found_bytes = file.metadata()?.len();
        // The preamble holds the container's length at byte 16.
        let mut preamble = [0; container::PREAMBLE_BYTES];
        let expected_bytes = match file.read_exact(&mut preamble) {
            Ok(()) => u64::from_le_bytes(preamble[16..24].try_into().expect("eight bytes")),
            Err(_) => container::PREAMBLE_BYTES as u64,
        };
        if expected_bytes > found_bytes {
            return Err(damaged(ContainerError::Length { expected_bytes, found_bytes }));
        }
        let mut head = vec![0; expected_bytes as usize];
        file.seek(SeekFrom::Start(0))?;
        file.read_exact(&mut head)?;
        let (header, regions, runs) = parse(&AlignedBytes::copy_of(&head)).map_err(damaged)?;
        let expected = header
            .n_entries
            .checked_mul(size_of::<PackedEntry>() as u64)
            .and_then(|entries| entries.checked_add(expected_bytes));
        if expected != Some(found_bytes) {
            let expected_bytes = expected.unwrap_or(u64::MAX);
            return Err(damaged(ContainerError::Length { expected_bytes, found_bytes }));
        }
        let file = Self {
            path: path.to_owned(),
            n_regions: header.n_regions as usize,
            n_entries: header.n_entries,
            entries_at_bytes: expected_bytes,
            runs,
        };
        Ok((file, regions))
    }

    pub fn entries_of_run(&self, run: usize) -> Range<u64> {
        self.runs[run].start..self.runs.get(run + 1).map_or(self.n_entries, |next| next.start)
    }

    pub(super) fn read(&self, runs: Range<usize>) -> Result<Vec<PackedEntry>, ContributionError> {
        if runs.is_empty() {
            return Ok(Vec::new());
        }
        let (start, end) = (self.entries_of_run(runs.start).start, self.entries_of_run(runs.end - 1).end);
        let mut entries = vec![PackedEntry::zeroed(); (end - start) as usize];
        let mut file = fs_err::File::open(&self.path)?;
        file.seek(SeekFrom::Start(self.offset_bytes(start)))?;
        file.read_exact(bytemuck::cast_slice_mut(&mut entries))?;
        for run in runs {
            let range = self.entries_of_run(run);
            self.check(run, &entries[(range.start - start) as usize..(range.end - start) as usize])?;
        }
        Ok(entries)
    }

    fn offset_bytes(&self, entry: u64) -> u64 {
        self.entries_at_bytes + entry * size_of::<PackedEntry>() as u64
    }

    fn check(&self, run: usize, entries: &[PackedEntry]) -> Result<(), ContributionError> {
        let Run { start, checksum: expected, .. } = self.runs[run];
        let damaged = |source| ContributionError::Damaged { path: self.path.clone(), source };
        let offset_bytes = self.offset_bytes(start);
        let found = checksum(entries);
        if found != expected {
            let id = ENTRIES;
            return Err(damaged(ContainerError::Checksum { id, offset_bytes, expected, found }));
        }
        let usable = |e: &PackedEntry| (e.region() as usize) < self.n_regions && e.weight.is_finite();
        if !entries.iter().fold(true, |all, e| all & usable(e)) {
            let what = "entries that are not finite or of unknown regions".into();
            return Err(damaged(ContainerError::Damaged { offset_bytes, what }));
        }
        Ok(())
    }
}

fn parse(bytes: &[u8]) -> Result<(Header, ViewRegions, Vec<Run>), ContainerError> {
    let layout = Layout::check(bytes, MAGIC, VERSION)?;
    let header: Header = layout.value(bytes, 1, "header")?;
    let (n_regions, n_masks, dim) = (header.n_regions as usize, header.n_masks as usize, header.dim as usize);
    let starts: Vec<u32> = layout.values(bytes, 2, "region starts", n_regions + 1)?;
    let n_listed = header.n_region_masks as usize;
    let masks: Vec<u32> = layout.values(bytes, 3, "region masks", n_listed)?;
    let n_components = n_masks.saturating_mul(dim);
    let mask_vectors = layout.values(bytes, 4, "mask vectors", n_components)?;
    let runs: Vec<Run> = layout.values(bytes, 5, "runs", header.n_runs as usize)?;
    let consistent = dim > 0
        && starts.is_sorted()
        && starts[0] == 0
        && starts[n_regions] as usize == masks.len()
        && masks.iter().all(|m| (*m as usize) < n_masks)
        && runs.is_sorted_by(|a, b| (a.cell_id, a.slice) < (b.cell_id, b.slice) && a.start <= b.start)
        && runs.first().map_or(header.n_entries, |run| run.start) == 0
        && runs.last().is_none_or(|run| run.start <= header.n_entries);
    if !consistent {
        let what = "regions, masks or runs out of range".into();
        return Err(ContainerError::Damaged { offset_bytes: 0, what });
    }
    Ok((header, ViewRegions { dim, mask_vectors, starts, masks }, runs))
}
