//! Scores each level of masks separately and combines them per query, so that the mask of a whole thing is not averaged with those
//! of its parts.
//!
//! With only the masks `j` of level `l`, a Gaussian's embedding is the direction of
//!
//! ```text
//! S_l = Σ_r a(k, r) Σ_{j covers r, of level l} m_j e_j
//! ```
//!
//! and its score is the best of the levels' cosines, as LangSplat (Qin et al. 2024) takes the best of its three fields.
//! The contributions are those of the plain field; only each mask's level is published in addition.

use rayon::prelude::*;
use slag_common::manifest::CellRecord;

use super::{QueryError, Scores, check_dim, scores_of_cells};
use crate::lift::published::{read_field, read_regions};
use crate::lift::{CellField, RegionTable};
use crate::store::StoreReader;
use slag_math::dot;

/// Smallest length of a level's sum, relative to the longest: a shorter one says nothing about a Gaussian.
const LEAST_SHARE: f32 = 0.1;

/// A published field, scored by level of masks.
pub struct ByLevel<'a> {
    reader: &'a StoreReader,
    table: RegionTable,
    /// Of each cell, `[N][n_levels]`: lengths of `S_l`.
    lengths_of_cell: Vec<Vec<f32>>,
}

impl<'a> ByLevel<'a> {
    /// Reads the field once and computes the lengths of the levels' sums.
    pub fn read(reader: &'a StoreReader) -> Result<Self, QueryError> {
        let table = read_regions(reader)?;
        let lengths = |cell: &CellRecord| {
            let field = read_field(reader, cell.cell_id, cell.n_gaussians, table.len())?;
            Ok(lengths(&field, &table))
        };
        let lengths_of_cell =
            reader.manifest().cells.iter().map(lengths).collect::<Result<_, QueryError>>()?;
        Ok(Self { reader, table, lengths_of_cell })
    }

    /// Scores every Gaussian against a unit query vector, as [`super::scores`] does.
    pub fn scores(&self, query: &[f32]) -> Result<Scores, QueryError> {
        check_dim(self.reader, &self.table, query)?;
        let of_regions = self.table.scores_by_level(query);
        scores_of_cells(self.reader, self.table.len(), |cell, field| {
            best_of_levels(field, &of_regions, &self.lengths_of_cell[cell], self.table.n_levels())
        })
    }
}

/// Returns `[N][n_levels]`: the lengths of `S_l`.
fn lengths(field: &CellField, table: &RegionTable) -> Vec<f32> {
    let (dim, n_levels) = (table.dim(), table.n_levels());
    let mut lengths = vec![0.0; field.len() * n_levels];
    lengths.par_chunks_exact_mut(n_levels).enumerate().for_each_init(
        || (vec![0.0f32; table.n_masks()], Vec::new(), vec![0.0f32; n_levels * dim]),
        |(count_of_mask, masks, sums), (k, lengths)| {
            for (region, weight) in field.entries(k) {
                for (mask, share) in table.masks_of(region) {
                    masks.push(mask);
                    count_of_mask[mask as usize] += weight * share;
                }
            }
            masks.sort_unstable();
            masks.dedup();
            sums.fill(0.0);
            for mask in masks.drain(..) {
                let count = std::mem::take(&mut count_of_mask[mask as usize]);
                let sum = &mut sums[table.level_of(mask) * dim..][..dim];
                let vector = table.mask_vectors().get(mask as usize);
                sum.iter_mut().zip(vector).for_each(|(s, v)| *s += count * v);
            }
            for (length, sum) in lengths.iter_mut().zip(sums.chunks_exact(dim)) {
                *length = dot(sum, sum).sqrt();
            }
        },
    );
    lengths
}

/// Returns the best cosine of each Gaussian's levels; NaN where there is no evidence.
fn best_of_levels(field: &CellField, of_regions: &[f32], lengths: &[f32], n_levels: usize) -> Vec<f32> {
    let score = |k: usize| {
        let lengths = &lengths[k * n_levels..][..n_levels];
        let longest = lengths.iter().copied().fold(0.0, f32::max);
        if !field.has_evidence(k) || longest <= 0.0 {
            return f32::NAN;
        }
        let mut sums = vec![0.0f64; n_levels];
        for (region, weight) in field.entries(k) {
            let of_region = &of_regions[region * n_levels..][..n_levels];
            sums.iter_mut().zip(of_region).for_each(|(sum, s)| *sum += f64::from(weight) * f64::from(*s));
        }
        let known = sums.iter().zip(lengths).filter(|(_, length)| **length >= LEAST_SHARE * longest);
        known.map(|(sum, length)| (sum / f64::from(*length)) as f32).fold(f32::MIN, f32::max)
    };
    (0..field.len()).into_par_iter().map(score).collect()
}

#[cfg(test)]
mod tests;
