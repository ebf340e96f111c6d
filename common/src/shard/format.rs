//! Constants, section ids and the header of the shard format.

use bytemuck::{Pod, Zeroable};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub const MAGIC: [u8; 8] = *b"SLAGSHRD";
/// Version of the shard format that is written and read.
pub const VERSION: u32 = 2;
/// Gaussians in a block of residual codes, which has a column of 32 bytes for each pair of subspaces.
pub const BLOCK: usize = 32;
/// Codewords of a subspace: a code takes half a byte.
pub const CODEWORDS: usize = 16;
pub const MAX_SUBSPACES: usize = 128;
/// Largest `dim` accepted: more than any text-image model has.
pub const MAX_DIM: usize = 8192;

pub mod section {
    /// [`super::ShardHeader`].
    pub const HEADER: u32 = 1;
    /// `[N]` u32, `[N][3]` u16 or `[N][3]` u32, see [`Positions`](crate::shard::Positions).
    pub const POSITIONS: u32 = 2;
    /// `[K + 1]` u32.
    pub const CENTROID_STARTS: u32 = 3;
    /// `[K][m]` i8.
    pub const CENTROIDS: u32 = 4;
    /// `[K]` f32.
    pub const RADII: u32 = 5;
    /// `[N]` u32, index in the input splat file.
    pub const INPUT_INDICES: u32 = 6;
    /// `[centroid_starts[K]][dim]` f16, unit embeddings.
    pub const EMBEDDINGS: u32 = 7;
    /// `[dim]` f16; absent: zero.
    pub const MEAN: u32 = 8;
    /// `[m][dim]` i8; absent: components are those of the embedding itself, and m = dim.
    pub const BASIS: u32 = 9;
    /// `[m]` f32, present with the basis.
    pub const BASIS_STEPS: u32 = 10;
    /// `[G + 1]` u32: subspace g has the components `starts[g]..starts[g + 1]`.
    pub const SUBSPACE_STARTS: u32 = 11;
    /// For each subspace `[16][components of the subspace]` f16.
    pub const CODEWORDS: u32 = 12;
    /// `[K]` f32: the factor of the codewords of a centroid's members.
    pub const RESIDUAL_SCALES: u32 = 13;
    /// `[K]` f32: the length of the longest decoded residual of a centroid's members, in components.
    pub const RESIDUAL_NORMS: u32 = 14;
    /// `[ceil(centroid_starts[K] / 32)][G / 2][32]` u8: two codes a byte, the even subspace in the low half.
    pub const CODES: u32 = 15;
    /// [`super::ScoreErrors`] of the fine residuals.
    pub const FINE_ERRORS: u32 = 16;
    /// `[m]` f32: the factor of each component of a fine residual.
    pub const FINE_STEPS: u32 = 17;
    /// `[K]` f32: the factor of the fine residuals of a centroid's members.
    pub const FINE_SCALES: u32 = 18;
    /// `[centroid_starts[K]][m]` i8.
    pub const FINE: u32 = 19;
    /// [`crate::shard::IndicesHeader`]. Other ids: 20 to 26 and 29 to 30 [`crate::objects`], 50 to 52
    /// [`crate::occupancy`], 60 and 61 [`crate::photo_poses`], 70 and 71 [`crate::landmarks`].
    pub const PACKED_INDICES_HEADER: u32 = 27;
    /// `[ceil(N * width_bits / 32)]` u32.
    pub const PACKED_INDICES: u32 = 28;
    /// `[N][4]` u8, see [`crate::appearance::Appearance`].
    pub const COLOURS: u32 = 40;
    /// `[N][3]` u8.
    pub const SIZES: u32 = 41;
    /// `[N][3]` u8.
    pub const ROTATIONS: u32 = 42;
}

/// Absolute errors of a profile's scores, measured over a bank of text vectors and a sample of the Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[repr(C)]
pub struct ScoreErrors {
    /// Mean over texts and Gaussians.
    pub mean: f32,
    /// For 95 of 100 texts like those held out of the bank, 99 of 100 scores err by no more; 0 where too few texts
    /// were held out.
    pub likely: f32,
    /// Largest.
    pub max: f32,
    /// Standard deviation of a text's scores over the Gaussians, averaged over the texts: the scale to compare
    /// errors with.
    pub spread: f32,
}

#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ShardHeader {
    pub cell_id: u32,
    pub n_gaussians: u32,
    /// Centroids of the codebook, K.
    pub n_centroids: u32,
    /// Components of an embedding.
    pub dim: u32,
    /// Components of a centroid, m.
    pub n_components: u32,
    /// Subspaces of the residual code, G; even; 0 without a residual code.
    pub n_subspaces: u32,
    /// Bits of a position's x, y and z, see [`PositionForm`].
    pub position_bits: [u8; 4],
    /// Factor of the 8-bit components of centroids.
    pub centroid_step: f32,
    /// Origin of the shard frame in the world frame.
    pub origin_in_world: [f64; 3],
    /// World units per step of a quantised position, per axis; the error is at most half a step.
    pub position_step: [f64; 3],
    /// Smallest corner of the box around the Gaussians' extents, world frame.
    pub box_min: [f64; 3],
    /// Largest corner.
    pub box_max: [f64; 3],
    /// Measured errors of this profile; in exact shards, of the residual code.
    pub errors: ScoreErrors,
    /// The encoder that defines the space of the centroids.
    pub encoder_id: [u8; 32],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PositionForm {
    /// 32 bits in all.
    Packed,
    /// 16 bits an axis.
    Wide,
    /// 32 bits an axis.
    Full,
}

impl PositionForm {
    pub fn of(bits: [u8; 4]) -> Self {
        match bits {
            [16, 16, 16, _] => Self::Wide,
            [32, 32, 32, _] => Self::Full,
            _ => Self::Packed,
        }
    }
}

/// The amount of data that a shard carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Centroids and positions.
    Compact,
    /// Centroids, positions and a residual code of each embedding.
    Balanced,
    /// Centroids, positions and every embedding as f16.
    Exact,
}

impl Profile {
    /// Smallest first.
    pub const ALL: [Self; 3] = [Self::Compact, Self::Balanced, Self::Exact];

    pub fn name(self) -> &'static str {
        match self {
            Self::Compact => "compact",
            Self::Balanced => "balanced",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Profile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Profile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|p| p.name() == text)
            .ok_or_else(|| format!("{text:?} is not a profile; use one of {}", names()))
    }
}
