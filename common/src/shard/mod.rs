//! A shard: the data of one cell in one file. The byte table and the reasons for it are in `docs/formats.md`.
//!
//! Gaussians are ordered by centroid of the codebook, then along a Morton curve. The members of centroid r are
//! therefore the run `centroid_starts[r]..centroid_starts[r + 1]`, without a column of codes. Gaussians without
//! evidence follow the last run and have no centroid.
//!
//! Centroids have 8-bit components in a basis of the cell's own, because the embeddings of a cell span few
//! dimensions: `P[r] = mean + centroid_step * sum over c of centroids[r][c] * basis_steps[c] * basis[c]`.
//!
//! A residual code splits the components into subspaces and names one of 16 codewords for each: `E ~ P[r] +
//! scale[r] * sum over g of sum over c in subspace g of codewords[g][code][c] * basis_steps[c] * basis[c]`.

mod columns;
mod decode;
mod format;
mod indices;
mod layout;
pub mod sample;
mod write;

#[cfg(test)]
mod object_tests;
#[cfg(test)]
mod tests;

pub use crate::quantise::quantise;
pub use columns::{Basis, ExactColumns, Fine, Positions, Residuals, ShardView};
pub use format::{
    BLOCK, CODEWORDS, MAGIC, MAX_DIM, MAX_SUBSPACES, PositionForm, Profile, ScoreErrors, ShardHeader,
    VERSION, section,
};
pub use indices::{IndexColumn, IndicesHeader, PackedIndices};
pub use layout::{HEADER_END_BYTES, ShardLayout};
pub use write::Additions;
