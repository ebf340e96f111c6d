//! The regions of all views: which masks cover each, and the masks' vectors.
//!
//! `V_r`, the sum of a region's mask vectors, is not stored: a mask has several regions, and a few additions compute it
//! when needed. So a scene's table is hardly larger than its mask vectors.
//!
//! In the plain average every mask has weight 1; [`RegionTable::set_mask_weights`] sets others, `V_r = Σ_j m_j e_j` and
//! `n_r = Σ_j m_j`. [`RegionTable::append_mixture`] adds a region of no view: any mixture of masks.

use std::io::{self, Write};
use std::ops::Range;

use rayon::prelude::*;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};
use slag_math::matrix::Rows;

use super::contributions::{ContributionError, MAX_IN_ALL};
use crate::masks::Mask;
use crate::memory::{MemoryPlan, Phase};

const MAGIC: [u8; 8] = *b"SLAGREGN";
const VERSION: u32 = 2;

/// Number of the first of `n_more` regions or masks after `n`.
fn first_number(n: usize, n_more: usize, what: &'static str) -> Result<u32, ContributionError> {
    let fits = n.checked_add(n_more).is_some_and(|end| end <= MAX_IN_ALL);
    if fits { Ok(n as u32) } else { Err(ContributionError::TooManyInAll { what }) }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct RegionTable {
    dim: usize,
    /// `[n_masks][dim]`, unit.
    mask_vectors: Vec<f32>,
    /// `[n + 1]`: start of each region's masks.
    starts: Vec<u64>,
    /// By region, numbered over the whole scene.
    masks: Vec<u32>,
    /// Weights of these; empty if all are 1.
    shares: Vec<f32>,
    /// `[n_masks]`: as of [`Mask::level`]; empty for a single level.
    levels: Vec<u8>,
}

impl RegionTable {
    pub fn new(dim: usize) -> Self {
        Self { dim, starts: vec![0], ..Self::default() }
    }

    pub fn dim(&self) -> usize {
        self.dim
    }

    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn n_masks(&self) -> usize {
        self.mask_vectors.len() / self.dim
    }

    pub fn len_bytes(&self) -> u64 {
        let numbers = size_of_val(&*self.starts) + size_of_val(&*self.masks) + size_of_val(&*self.shares);
        (size_of_val(&*self.mask_vectors) + numbers + self.levels.len()) as u64
    }

    pub(crate) fn reserve(&self, memory: &mut MemoryPlan) {
        memory.reserve(Phase::Always, "masks and regions of all views", self.len_bytes());
    }

    /// Appends a view's regions and returns the first one's number; `mask_vectors` is `[n][dim]`, and `masks_of_region`
    /// refers to it.
    ///
    /// # Errors
    /// [`ContributionError::TooManyInAll`] if regions or masks can no longer be numbered; the table is then as it was.
    pub(crate) fn append<'a>(
        &mut self,
        mask_vectors: &[f32],
        masks_of_region: impl ExactSizeIterator<Item = &'a [u32]>,
    ) -> Result<u32, ContributionError> {
        let first = first_number(self.len(), masks_of_region.len(), "regions")?;
        let n_masks = mask_vectors.len() / self.dim;
        let first_mask = first_number(self.n_masks(), n_masks, "masks")?;
        // Exact: doubling would exceed the budget's estimate.
        self.mask_vectors.reserve_exact(mask_vectors.len());
        self.mask_vectors.extend(mask_vectors);
        for masks in masks_of_region {
            self.masks.extend(masks.iter().map(|mask| mask + first_mask));
            self.starts.push(self.masks.len() as u64);
        }
        if !self.shares.is_empty() {
            self.shares.resize(self.masks.len(), 1.0);
        }
        Ok(first)
    }

    /// `weights`: `[n_masks]`, finite, not negative.
    pub(crate) fn set_mask_weights(&mut self, weights: &[f32]) {
        self.shares = self.masks.iter().map(|mask| weights[*mask as usize]).collect();
    }

    pub(crate) fn set_levels(&mut self, levels: Vec<u8>) {
        self.levels = if levels.iter().all(|level| *level == 0) { Vec::new() } else { levels };
    }

    /// Appends a mixture of masks, `(mask, weight)`, as a region; returns its number.
    pub(super) fn append_mixture(&mut self, mixture: &[(u32, f32)]) -> Result<u32, ContributionError> {
        let number = first_number(self.len(), 1, "regions")?;
        self.shares.resize(self.masks.len(), 1.0);
        self.masks.extend(mixture.iter().map(|(mask, _)| mask));
        self.shares.extend(mixture.iter().map(|(_, share)| share));
        self.starts.push(self.masks.len() as u64);
        Ok(number)
    }

    pub fn mask_vectors(&self) -> Rows<'_> {
        Rows::all(&self.mask_vectors, self.dim)
    }

    fn listed(&self, region: usize) -> Range<usize> {
        self.starts[region] as usize..self.starts[region + 1] as usize
    }

    /// Masks of a region, whatever their weights.
    pub(crate) fn all_masks_of(&self, region: usize) -> &[u32] {
        &self.masks[self.listed(region)]
    }

    /// Whether only fillers cover a region: in one view, fillers and other masks do not overlap.
    pub(crate) fn is_filled(&self, region: usize) -> bool {
        let level = |mask: &u32| self.levels.get(*mask as usize).copied().unwrap_or_default();
        self.all_masks_of(region).iter().all(|mask| level(mask) == Mask::FILLER)
    }

    #[inline(always)]
    pub fn masks_of(&self, region: usize) -> impl Iterator<Item = (u32, f32)> + '_ {
        let listed = self.listed(region);
        let shares = self.shares.get(listed.clone()).unwrap_or(&[]);
        let share = move |i: usize| shares.get(i).copied().unwrap_or(1.0);
        self.masks[listed].iter().enumerate().map(move |(i, mask)| (*mask, share(i)))
    }

    /// Summed weight of each region's masks: their number if all weights are 1.
    pub(super) fn mask_counts(&self, regions: Range<usize>) -> Vec<f32> {
        regions.map(|region| self.masks_of(region).map(|(_, share)| share).sum()).collect()
    }

    /// Writes components `from..from + out.len()` of `V_r`; inlined for the caller's instruction set.
    #[inline(always)]
    pub(super) fn components(&self, region: usize, from: usize, out: &mut [f32]) {
        out.fill(0.0);
        let vector = |mask: u32| &self.mask_vectors[mask as usize * self.dim + from..];
        for (mask, share) in self.masks_of(region) {
            // Products are rounded before they are added; a weight of 1 changes no bit.
            out.iter_mut().zip(vector(mask)).for_each(|(sum, v)| *sum += share * v);
        }
    }

    /// `q · V_r` for every region.
    pub fn scores(&self, query: &[f32]) -> Vec<f32> {
        let vectors = self.mask_vectors.par_chunks_exact(self.dim);
        let of_masks: Vec<f32> = vectors.map(|vector| slag_math::dot(vector, query)).collect();
        let score = |region| self.masks_of(region).map(|(mask, share)| share * of_masks[mask as usize]).sum();
        (0..self.len()).into_par_iter().map(score).collect()
    }

    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let header = [self.dim, self.len(), self.n_masks(), self.masks.len()].map(|n| n as u64);
        let mut sections = vec![
            (1, container::bytes_of(&header)),
            (2, container::bytes_of(&self.mask_vectors)),
            (3, container::bytes_of(&self.starts)),
            (4, container::bytes_of(&self.masks)),
        ];
        if !self.shares.is_empty() {
            sections.push((5, container::bytes_of(&self.shares)));
        }
        if !self.levels.is_empty() {
            sections.push((6, &self.levels));
        }
        container::write(out, MAGIC, VERSION, &sections)
    }

    pub fn from_bytes(bytes: &AlignedBytes) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let [dim, n, n_masks, n_listed] =
            layout.value::<[u64; 4]>(bytes, 1, "header")?.map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let table = Self {
            dim,
            mask_vectors: layout.values(bytes, 2, "mask vectors", n_masks.saturating_mul(dim))?,
            starts: layout.values(bytes, 3, "starts", n.saturating_add(1))?,
            masks: layout.values(bytes, 4, "masks", n_listed)?,
            shares: match layout.find(5) {
                Some(_) => layout.values(bytes, 5, "shares", n_listed)?,
                None => Vec::new(),
            },
            levels: match layout.find(6) {
                Some(_) => layout.values(bytes, 6, "levels", n_masks)?,
                None => Vec::new(),
            },
        };
        let consistent = dim > 0
            && are_starts(&table.starts, n_listed)
            && table.masks.iter().all(|mask| (*mask as usize) < n_masks)
            && table.shares.iter().all(|share| share.is_finite() && *share >= 0.0);
        if consistent {
            return Ok(table);
        }
        let what = "masks out of range, or weights that are not finite".into();
        Err(ContainerError::Damaged { offset_bytes: 0, what })
    }
}

/// Whether values ascend from 0 to `end`, as starts of `starts.len() - 1` rows do.
pub(super) fn are_starts(starts: &[u64], end: usize) -> bool {
    starts.first() == Some(&0) && starts.is_sorted() && starts.last() == Some(&(end as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The last 32-bit number marks "none"; a table that large cannot be made here.
    #[test]
    fn regions_and_masks_that_cannot_be_numbered_are_refused() {
        let number = |n, n_more| first_number(n, n_more, "regions").ok();
        assert_eq!(number(7, 3), Some(7));
        assert_eq!(number(u32::MAX as usize - 2, 1), Some(u32::MAX - 2));
        assert_eq!(number(u32::MAX as usize - 2, 2), None);
        assert_eq!(number(1 << 32, 0), None);
        assert_eq!(number(usize::MAX, 1), None);
    }
}
