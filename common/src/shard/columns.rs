//! The columns of a shard, and what can be read from them without decoding embeddings.

use std::ops::Range;

use glam::DVec3;
use half::f16;
use slag_math::random::mix64;

use super::format::{BLOCK, ScoreErrors, ShardHeader};
use super::indices::PackedIndices;
use crate::container;
use crate::frames::Aabb;
use crate::hash::Hash32;

/// Quantised means (x, y, z), in steps of `position_step` from `origin_in_world`.
#[derive(Clone, Copy, Debug)]
pub enum Positions<'a> {
    /// From the lowest bit up, `position_bits` wide.
    Packed(&'a [u32]),
    Wide(&'a [[u16; 3]]),
    Full(&'a [[u32; 3]]),
}

impl Positions<'_> {
    pub(super) fn bytes(&self) -> &[u8] {
        match self {
            Self::Packed(words) => container::bytes_of(words),
            Self::Wide(steps) => container::bytes_of(steps),
            Self::Full(steps) => container::bytes_of(steps),
        }
    }

    #[inline]
    fn steps(&self, index: usize, bits: [u8; 4]) -> [u32; 3] {
        match self {
            Self::Wide(steps) => steps[index].map(u32::from),
            Self::Full(steps) => steps[index],
            Self::Packed(words) => {
                let word = u64::from(words[index]);
                let part = |shift: u8, bits: u8| (word >> shift & ((1 << bits) - 1)) as u32;
                [part(0, bits[0]), part(bits[0], bits[1]), part(bits[0] + bits[1], bits[2])]
            }
        }
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Basis<'a> {
    /// `[dim]`.
    pub mean: &'a [f16],
    /// `[m][dim]`.
    pub vectors: &'a [i8],
    /// `[m]`.
    pub steps: &'a [f32],
}

#[derive(Clone, Copy, Debug)]
pub struct Residuals<'a> {
    /// `[G + 1]`, strictly ascending, at most m.
    pub subspace_starts: &'a [u32],
    /// For each subspace `[16][components of the subspace]`.
    pub codewords: &'a [f16],
    /// `[K]`.
    pub residual_scales: &'a [f32],
    /// `[K]`: the length of the longest decoded residual of the members, as a vector of components.
    pub residual_norms: &'a [f32],
    /// `[ceil(centroid_starts[K] / 32)][G / 2][32]`.
    pub codes: &'a [u8],
}

impl Residuals<'_> {
    pub fn code(&self, index: usize, subspace: usize) -> usize {
        let n_bytes = (self.subspace_starts.len() - 1) / 2;
        let byte = self.codes[(index / BLOCK * n_bytes + subspace / 2) * BLOCK + index % BLOCK];
        usize::from(if subspace.is_multiple_of(2) { byte & 15 } else { byte >> 4 })
    }
}

#[derive(Clone, Copy, Debug)]
pub struct ExactColumns<'a> {
    /// `[N]` index in the input splat file.
    pub input_indices: &'a [u32],
    /// `[centroid_starts[K]][dim]` unit embeddings.
    pub embeddings: &'a [f16],
    /// Residuals of intermediate precision; absent without a residual code.
    pub fine: Option<Fine<'a>>,
}

/// Residuals with 8 bits a component; a Gaussian's take an eighth of the bytes of its embedding.
#[derive(Clone, Copy, Debug)]
pub struct Fine<'a> {
    pub errors: ScoreErrors,
    /// `[m]`.
    pub steps: &'a [f32],
    /// `[K]`.
    pub scales: &'a [f32],
    /// `[centroid_starts[K]][m]`.
    pub values: &'a [i8],
}

/// A shard's columns, borrowed from its bytes or from the data to be written.
#[derive(Clone, Copy, Debug)]
pub struct ShardView<'a> {
    pub header: ShardHeader,
    /// `[N]`; decode with [`ShardView::position_in_world`].
    pub positions: Positions<'a>,
    /// `[K + 1]`, ascending.
    pub centroid_starts: &'a [u32],
    /// `[K][m]`.
    pub centroids: &'a [i8],
    /// `[K]`: at least the largest `||E_k - E'_k||` of the centroid's members, where E' is the embedding as this
    /// profile decodes it (the centroid, or the centroid and the residual); in exact shards E' is the centroid.
    pub radii: &'a [f32],
    /// The basis of the components; absent: components are those of the embedding itself.
    pub basis: Option<Basis<'a>>,
    /// The residual code, in the balanced and exact profiles.
    pub residuals: Option<Residuals<'a>>,
    pub exact: Option<ExactColumns<'a>>,
    /// Indices in the input splat file, if encoded with them; exact shards have a column of their own.
    pub packed_indices: Option<PackedIndices<'a>>,
}

impl ShardView<'_> {
    /// Returns the mean of a Gaussian, accurate to half a step per axis.
    #[inline]
    pub fn position_in_world(&self, index: usize) -> DVec3 {
        let steps = self.positions.steps(index, self.header.position_bits).map(f64::from);
        DVec3::from(self.header.origin_in_world) + DVec3::from(steps) * DVec3::from(self.header.position_step)
    }

    /// Digest of the Gaussians' positions in any order: equal for shards of a cell while the splat is unchanged.
    pub fn splat_digest(&self) -> u64 {
        let chained = |digest: u64, bits: u64| mix64(digest ^ bits);
        let grid = self.header.origin_in_world.iter().chain(&self.header.position_step);
        let grid = grid.fold(0, |digest, v| chained(digest, v.to_bits()));
        let gaussian = |index: usize| {
            let steps = self.positions.steps(index, self.header.position_bits);
            steps.into_iter().fold(grid, |digest, step| chained(digest, step.into()))
        };
        (0..self.header.n_gaussians as usize).fold(0, |sum: u64, index| sum.wrapping_add(gaussian(index)))
    }

    pub fn has_input_indices(&self) -> bool {
        self.exact.is_some() || self.packed_indices.is_some()
    }

    pub fn input_index(&self, index: usize) -> Option<u32> {
        let packed = || self.packed_indices.map(|indices| indices.get(index));
        self.exact.map(|exact| exact.input_indices[index]).or_else(packed)
    }

    pub fn position_box(&self) -> Aabb {
        self.header.position_box()
    }

    pub fn members(&self, centroid: usize) -> Range<usize> {
        self.centroid_starts[centroid] as usize..self.centroid_starts[centroid + 1] as usize
    }

    pub fn centroid_of(&self, index: usize) -> usize {
        self.centroid_starts.partition_point(|start| *start as usize <= index) - 1
    }

    pub fn n_with_evidence(&self) -> usize {
        self.centroid_starts[self.header.n_centroids as usize] as usize
    }

    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.header.box_min.into(), max: self.header.box_max.into() }
    }

    pub fn encoder_id(&self) -> Hash32 {
        Hash32(self.header.encoder_id)
    }
}
