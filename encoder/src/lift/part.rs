//! A part: the unit in which contributions are brought together by Gaussian.

use std::ops::Range;

use crate::cells::CellSplit;

/// Consecutive Gaussians of a cell: all of them, unless they have very many entries.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    pub cell_id: u32,
    pub number: u32,
    /// Its Gaussians, by their index within the cell.
    pub(crate) locals: Range<usize>,
    pub n_entries: u64,
    /// Its slices, numbered over the whole scene.
    pub(super) slices: Range<usize>,
}

impl Part {
    /// Returns the scene indices of the part's Gaussians.
    pub fn gaussians<'a>(&self, split: &'a CellSplit) -> &'a [u32] {
        &split.cells[self.cell_id as usize].gaussians[self.locals.clone()]
    }
}

/// The contributions of a part by Gaussian, in canonical order: views by name, then regions.
#[derive(Clone, Debug, PartialEq)]
pub struct PartContributions {
    pub part: Part,
    /// `[N + 1]`: where each Gaussian's entries start.
    pub starts: Vec<u64>,
    /// Region of each entry, numbered over the whole scene.
    pub regions: Vec<u32>,
    pub weights: Vec<f32>,
    /// `[N]`: `Σ_r a(k, r) n_r`, the evidence.
    pub total_weights: Vec<f32>,
}

impl PartContributions {
    /// Returns a part with the space for its entries.
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
}
