//! The regions of all views: which masks cover each, and the masks' vectors.
//!
//! `V_r`, the sum of a region's mask vectors, is never kept: there are several regions a mask, and a
//! few additions bring it back, so a scene's table is as large as its mask vectors.

use std::io::{self, Write};
use std::ops::Range;

use crate::palette::matrix::Rows;
use rayon::prelude::*;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

const MAGIC: [u8; 8] = *b"SLAGREGN";
const VERSION: u32 = 2;

/// The masks of every region of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionTable {
    dim: usize,
    /// `[n_masks][dim]`, unit.
    mask_vectors: Vec<f32>,
    /// `[n + 1]`: where each region's masks start.
    starts: Vec<u64>,
    /// Masks of each region, numbered over the whole scene.
    masks: Vec<u32>,
}

impl RegionTable {
    /// A table without regions, for vectors of `dim` components.
    pub fn new(dim: usize) -> Self {
        Self { dim, mask_vectors: Vec::new(), starts: vec![0], masks: Vec::new() }
    }

    /// Returns the components of a vector.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Returns the number of regions.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the number of masks.
    pub fn n_masks(&self) -> usize {
        self.mask_vectors.len() / self.dim
    }

    /// Returns the bytes that the table takes in memory.
    pub fn len_bytes(&self) -> u64 {
        (size_of_val(&*self.mask_vectors) + size_of_val(&*self.starts) + size_of_val(&*self.masks)) as u64
    }

    /// Appends a view's regions and returns the number of the first; `mask_vectors` is `[n][dim]`,
    /// `masks_of_region` refers to it.
    pub fn append<'a>(
        &mut self,
        mask_vectors: &[f32],
        masks_of_region: impl Iterator<Item = &'a [u32]>,
    ) -> u32 {
        let (first, first_mask) = (self.len() as u32, self.n_masks() as u32);
        // Exactly: doubling would take twice the memory that the budget knows of.
        self.mask_vectors.reserve_exact(mask_vectors.len());
        self.mask_vectors.extend(mask_vectors);
        for masks in masks_of_region {
            self.masks.extend(masks.iter().map(|mask| mask + first_mask));
            self.starts.push(self.masks.len() as u64);
        }
        first
    }

    /// Returns the masks' vectors, one a row.
    pub fn mask_vectors(&self) -> Rows<'_> {
        Rows::all(&self.mask_vectors, self.dim)
    }

    /// Returns the masks of a region.
    pub(crate) fn masks_of(&self, region: usize) -> &[u32] {
        &self.masks[self.starts[region] as usize..self.starts[region + 1] as usize]
    }

    /// Returns how many masks cover each region of a view.
    pub(super) fn mask_counts(&self, regions: Range<usize>) -> Vec<f32> {
        regions.map(|region| self.masks_of(region).len() as f32).collect()
    }

    /// Writes components `from..from + out.len()` of `V_r`; inlined to be compiled for its caller's vectors.
    #[inline(always)]
    pub(super) fn components(&self, region: usize, from: usize, out: &mut [f32]) {
        out.fill(0.0);
        for mask in self.masks_of(region) {
            let vector = &self.mask_vectors[*mask as usize * self.dim + from..][..out.len()];
            out.iter_mut().zip(vector).for_each(|(sum, v)| *sum += v);
        }
    }

    /// Returns `q · V_r` for every region.
    pub fn scores(&self, query: &[f32]) -> Vec<f32> {
        let of_masks: Vec<f32> =
            self.mask_vectors.par_chunks_exact(self.dim).map(|vector| super::dot(vector, query)).collect();
        let score = |region| self.masks_of(region).iter().map(|mask| of_masks[*mask as usize]).sum();
        (0..self.len()).into_par_iter().map(score).collect()
    }

    /// Writes the file form.
    ///
    /// # Errors
    /// Whatever the writer gives.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        let header = [self.dim, self.len(), self.n_masks(), self.masks.len()].map(|n| n as u64);
        let sections = [
            (1, container::bytes_of(&header)),
            (2, container::bytes_of(&self.mask_vectors)),
            (3, container::bytes_of(&self.starts)),
            (4, container::bytes_of(&self.masks)),
        ];
        container::write(out, MAGIC, VERSION, &sections)
    }

    /// Reads the file form.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte.
    pub fn from_bytes(bytes: &AlignedBytes) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let [dim, n, n_masks, n_listed] =
            layout.value::<[u64; 4]>(bytes, 1, "header")?.map(|n| usize::try_from(n).unwrap_or(usize::MAX));
        let vectors = layout.column::<f32>(2, "mask vectors", n_masks.saturating_mul(dim))?;
        let starts = layout.column::<u64>(3, "starts", n.saturating_add(1))?;
        let masks = layout.column::<u32>(4, "masks", n_listed)?;
        let table = Self {
            dim,
            mask_vectors: bytemuck::pod_collect_to_vec(&bytes[vectors]),
            starts: bytemuck::pod_collect_to_vec(&bytes[starts]),
            masks: bytemuck::pod_collect_to_vec(&bytes[masks]),
        };
        let consistent = dim > 0
            && super::are_starts(&table.starts, n_listed)
            && table.masks.iter().all(|mask| (*mask as usize) < n_masks);
        if consistent {
            return Ok(table);
        }
        let what = "regions refer to masks that are not there".into();
        Err(ContainerError::Damaged { offset_bytes: 0, what })
    }
}
