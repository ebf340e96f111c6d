//! Dense products with the same bits on any machine: lanes are columns, so every element is one chain of fused
//! multiply-adds whatever the vector width.

use pulp::Simd;
use rayon::prelude::*;

use crate::simd::{InstructionSet, Work};

/// Columns packed together: a multiple of every machine's lanes.
const PANEL: usize = 32;
/// Rows processed together; with two vectors of columns their sums fill the registers.
const TILE: usize = 4;
/// Rows per task of a thread.
const CHUNK: usize = 256;

/// Some rows of a row-major matrix.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    /// `[..][width]`.
    pub values: &'a [f32],
    pub width: usize,
    /// Row numbers, in order; absent: all.
    pub index: Option<&'a [u32]>,
}

impl<'a> Rows<'a> {
    pub fn all(values: &'a [f32], width: usize) -> Self {
        Self { values, width, index: None }
    }

    pub fn len(&self) -> usize {
        self.index.map_or(self.values.len() / self.width, <[u32]>::len)
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn get(&self, row: usize) -> &'a [f32] {
        let row = self.index.map_or(row, |index| index[row] as usize);
        &self.values[row * self.width..][..self.width]
    }
}

/// A matrix packed as the right factor of products.
pub struct Panels {
    /// `[ceil(n_columns / PANEL)][n_rows][PANEL]`, zeros past the last column.
    values: Vec<[f32; PANEL]>,
    n_rows: usize,
    n_columns: usize,
}

impl Panels {
    pub fn new(n_rows: usize, n_columns: usize, at: impl Fn(usize, usize) -> f32) -> Self {
        let mut values = vec![[0.0; PANEL]; n_columns.div_ceil(PANEL) * n_rows];
        for (place, row_of_panel) in values.iter_mut().enumerate() {
            let (panel, row) = (place / n_rows, place % n_rows);
            for (lane, value) in row_of_panel.iter_mut().enumerate().take(n_columns - panel * PANEL) {
                *value = at(row, panel * PANEL + lane);
            }
        }
        Self { values, n_rows, n_columns }
    }

    /// Returns `left * self`, `[rows][n_columns]`.
    pub fn product(&self, left: Rows<'_>) -> Vec<f32> {
        let mut out = vec![0.0; left.len() * self.n_columns];
        out.par_chunks_mut(CHUNK * self.n_columns).enumerate().for_each(|(chunk, out)| {
            InstructionSet::widest().dispatch(Product { left, right: self, first: chunk * CHUNK, out })
        });
        out
    }

    /// Returns per row of `left` the first column with the largest product minus offset. `offsets`: `[n_columns]`.
    pub fn largest(&self, left: Rows<'_>, offsets: &[f32]) -> Vec<u32> {
        let mut padded = vec![[f32::INFINITY; PANEL]; self.n_columns.div_ceil(PANEL)];
        padded.as_flattened_mut()[..offsets.len()].copy_from_slice(offsets);
        let mut out = vec![0; left.len()];
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
            let first = chunk * CHUNK;
            InstructionSet::widest().dispatch(Largest { left, right: self, offsets: &padded, first, out });
        });
        out
    }
}

struct Product<'a> {
    left: Rows<'a>,
    right: &'a Panels,
    first: usize,
    out: &'a mut [f32],
}

impl<S: Simd> Work<S> for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self, simd: S) {
        let width = self.right.n_columns;
        for (tile, out) in self.out.chunks_mut(TILE * width).enumerate() {
            let rows = tile_rows(self.left, self.first + tile * TILE, out.len() / width);
            for (at, panel) in self.right.values.chunks_exact(self.right.n_rows).enumerate() {
                let columns = at * PANEL..width.min((at + 1) * PANEL);
                let mut sums = [[0.0f32; PANEL]; TILE];
                for pair in 0..PANEL / (2 * S::F32_LANES) {
                    let found = tile_sums(simd, rows, panel, pair);
                    for (sums, found) in sums.iter_mut().zip(found) {
                        S::as_mut_simd_f32s(sums).0[2 * pair..][..2].copy_from_slice(&found);
                    }
                }
                for (out, sums) in out.chunks_exact_mut(width).zip(&sums) {
                    out[columns.clone()].copy_from_slice(&sums[..columns.len()]);
                }
            }
        }
    }
}

struct Largest<'a> {
    left: Rows<'a>,
    right: &'a Panels,
    offsets: &'a [[f32; PANEL]],
    first: usize,
    out: &'a mut [u32],
}

impl<S: Simd> Work<S> for Largest<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self, simd: S) {
        for (tile, out) in self.out.chunks_mut(TILE).enumerate() {
            let rows = tile_rows(self.left, self.first + tile * TILE, out.len());
            let mut best = [[simd.splat_f32s(f32::NEG_INFINITY); 2]; TILE];
            // Number of the vector pair in which each lane's best was found.
            let mut place = [[simd.splat_u32s(0); 2]; TILE];
            let n_pairs = PANEL / (2 * S::F32_LANES);
            for (at, panel) in self.right.values.chunks_exact(self.right.n_rows).enumerate() {
                for pair in 0..n_pairs {
                    let found = tile_sums(simd, rows, panel, pair);
                    let offsets = &S::as_simd_f32s(&self.offsets[at]).0[2 * pair..][..2];
                    let number = simd.splat_u32s((at * n_pairs + pair) as u32);
                    for row in 0..TILE {
                        for half in 0..2 {
                            let value = simd.sub_f32s(found[row][half], offsets[half]);
                            let is_better = simd.greater_than_f32s(value, best[row][half]);
                            best[row][half] = simd.select_f32s(is_better, value, best[row][half]);
                            place[row][half] = simd.select_u32s(is_better, number, place[row][half]);
                        }
                    }
                }
            }
            for ((out, best), place) in out.iter_mut().zip(&best).zip(&place) {
                let values: &[f32] = bytemuck::cast_slice(best);
                let numbers: &[u32] = bytemuck::cast_slice(place);
                let column = |lane: usize| numbers[lane] * 2 * S::F32_LANES as u32 + lane as u32;
                let mut chosen = (f32::NEG_INFINITY, u32::MAX);
                for (lane, value) in values.iter().enumerate() {
                    if *value > chosen.0 || *value == chosen.0 && column(lane) < chosen.1 {
                        chosen = (*value, column(lane));
                    }
                }
                // If every product is NaN or minus infinity, any column will do.
                *out = if chosen.1 == u32::MAX { 0 } else { chosen.1 };
            }
        }
    }
}

/// Returns rows `first..first + n`; the last is repeated.
#[inline(always)]
fn tile_rows(left: Rows<'_>, first: usize, n: usize) -> [&[f32]; TILE] {
    std::array::from_fn(|row| left.get(first + row.min(n - 1)))
}

#[inline(always)]
fn tile_sums<S: Simd>(
    simd: S,
    rows: [&[f32]; TILE],
    panel: &[[f32; PANEL]],
    pair: usize,
) -> [[S::f32s; 2]; TILE] {
    let rows = rows.map(|row| &row[..panel.len()]);
    let mut sums = [[simd.splat_f32s(0.0); 2]; TILE];
    for (k, of_panel) in panel.iter().enumerate() {
        let columns = &S::as_simd_f32s(of_panel).0[2 * pair..][..2];
        for (sums, row) in sums.iter_mut().zip(rows) {
            let factor = simd.splat_f32s(row[k]);
            sums[0] = simd.mul_add_f32s(factor, columns[0], sums[0]);
            sums[1] = simd.mul_add_f32s(factor, columns[1], sums[1]);
        }
    }
    sums
}

#[cfg(test)]
mod tests;
