//! The factorised field of a cell, sparse contributions over the scene's region vectors, and its scores.

use std::io::{self, Write};

use rayon::prelude::*;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::embeddings::{make_unit, write_embeddings};
use super::index::PartContributions;
use super::table::{RegionTable, are_starts};
use crate::store::{StoreError, StoreReader};

const MAGIC: [u8; 8] = *b"SLAGFELD";
const VERSION: u32 = 1;

/// Sparse contributions of a cell, by Gaussian.
#[derive(Clone, Debug, PartialEq)]
pub struct CellField {
    /// `[N]`: indices in the input file.
    pub input_indices: Vec<u32>,
    /// `[N + 1]`: start of each Gaussian's entries.
    pub starts: Vec<u64>,
    pub regions: Vec<u32>,
    pub weights: Vec<f32>,
    /// `[N]`: `Σ_r a(k, r) n_r`, the evidence for the embedding.
    pub total_weights: Vec<f32>,
    /// `[N]`: 0 without evidence.
    pub mean_lengths: Vec<f32>,
}

impl CellField {
    /// Makes a part's field and writes its embeddings to `embeddings` (`[N][dim]`): unit, or zeros without evidence.
    /// `input_indices`: of the part's Gaussians.
    pub fn new(
        input_indices: Vec<u32>,
        contributions: PartContributions,
        table: &RegionTable,
        embeddings: &mut [f32],
    ) -> Self {
        let mean_lengths = write_embeddings(&contributions, table, embeddings);
        let PartContributions { starts, regions, weights, total_weights, .. } = contributions;
        Self { input_indices, starts, regions, weights, total_weights, mean_lengths }
    }

    pub(super) fn append(&mut self, next: Self) {
        let n_entries = self.regions.len() as u64;
        self.starts.extend(next.starts[1..].iter().map(|start| start + n_entries));
        self.input_indices.extend(next.input_indices);
        self.regions.extend(next.regions);
        self.weights.extend(next.weights);
        self.total_weights.extend(next.total_weights);
        self.mean_lengths.extend(next.mean_lengths);
    }

    pub fn len(&self) -> usize {
        self.input_indices.len()
    }

    pub fn is_empty(&self) -> bool {
        self.input_indices.is_empty()
    }

    pub fn entries(&self, k: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        let range = self.starts[k] as usize..self.starts[k + 1] as usize;
        self.regions[range.clone()].iter().map(|r| *r as usize).zip(self.weights[range].iter().copied())
    }

    pub fn has_evidence(&self, k: usize) -> bool {
        self.mean_lengths[k] > 0.0
    }

    /// Writes a Gaussian's unit embedding, or zeros without evidence.
    pub fn embedding(&self, k: usize, table: &RegionTable, out: &mut [f32]) {
        let mut vector = vec![0.0; table.dim()];
        out.fill(0.0);
        for (region, weight) in self.entries(k) {
            table.components(region, 0, &mut vector);
            out.iter_mut().zip(&vector).for_each(|(s, v)| *s += weight * v);
        }
        make_unit(out, self.total_weights[k]);
    }

    /// Cosines of all embeddings with a unit query, from its scores with the regions ([`RegionTable::scores`]); NaN
    /// without evidence.
    pub fn cosines(&self, region_scores: &[f32]) -> Vec<f32> {
        let cosine = |k: usize| {
            if !self.has_evidence(k) {
                return f32::NAN;
            }
            let sum: f64 = self.entries(k).map(|(r, w)| f64::from(w) * f64::from(region_scores[r])).sum();
            (sum / (f64::from(self.total_weights[k]) * f64::from(self.mean_lengths[k]))) as f32
        };
        (0..self.len()).into_par_iter().map(cosine).collect()
    }

    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let header = [self.len() as u64, self.regions.len() as u64];
        let sections = [
            (1, container::bytes_of(&header)),
            (2, container::bytes_of(&self.input_indices)),
            (3, container::bytes_of(&self.starts)),
            (4, container::bytes_of(&self.regions)),
            (5, container::bytes_of(&self.weights)),
            (6, container::bytes_of(&self.total_weights)),
            (7, container::bytes_of(&self.mean_lengths)),
        ];
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Regions must be below `n_regions`.
    pub fn from_bytes(bytes: &AlignedBytes, n_regions: usize) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let [n, n_entries]: [u64; 2] = layout.value(bytes, 1, "header")?;
        let (n, n_entries) = (n as usize, n_entries as usize);
        let field = Self {
            input_indices: layout.values(bytes, 2, "input indices", n)?,
            starts: layout.values(bytes, 3, "starts", n.saturating_add(1))?,
            regions: layout.values(bytes, 4, "regions", n_entries)?,
            weights: layout.values(bytes, 5, "weights", n_entries)?,
            total_weights: layout.values(bytes, 6, "total weights", n)?,
            mean_lengths: layout.values(bytes, 7, "mean lengths", n)?,
        };
        let consistent =
            are_starts(&field.starts, n_entries) && field.regions.iter().all(|r| (*r as usize) < n_regions);
        if consistent {
            return Ok(field);
        }
        let what = "starts or regions out of range".into();
        Err(ContainerError::Damaged { offset_bytes: 0, what })
    }
}

pub(crate) const EXTRA_REGIONS: &str = "regions";

/// Record of the refinements ([`super::Aggregation`], JSON); absent for the plain average.
pub(crate) const EXTRA_AGGREGATION: &str = "aggregation";

pub(crate) fn extra_field(cell_id: u32, part: u32) -> String {
    format!("field/{cell_id}/{part}")
}

pub fn read_field(
    reader: &StoreReader,
    cell_id: u32,
    n_gaussians: u32,
    n_regions: usize,
) -> Result<CellField, StoreError> {
    let read_part = |part| {
        let name = extra_field(cell_id, part);
        let bytes = read_extra(reader, &name)?;
        CellField::from_bytes(&bytes, n_regions)
            .map_err(|fault| StoreError::Failed(format!("{name}: {fault}")))
    };
    let mut field = read_part(0)?;
    for part in 1.. {
        if field.len() >= n_gaussians as usize {
            break;
        }
        field.append(read_part(part)?);
    }
    Ok(field)
}

pub fn read_regions(reader: &StoreReader) -> Result<RegionTable, StoreError> {
    let bytes = read_extra(reader, EXTRA_REGIONS)?;
    RegionTable::from_bytes(&bytes).map_err(|fault| StoreError::Failed(format!("{EXTRA_REGIONS}: {fault}")))
}

fn read_extra(reader: &StoreReader, name: &str) -> Result<AlignedBytes, StoreError> {
    let absent = || format!("the store has no {name}: another version published it; encode again");
    let hash = reader.current().extras.get(name).ok_or_else(|| StoreError::Failed(absent()))?;
    reader.read_object(*hash)
}
