//! Stage 4: sums per (Gaussian, region) become embeddings.
//!
//! The paper's weighted average (Szilagyi et al. 2025, the equation for E_k) over all views i, masks
//! j and pixels p is, with the pixels grouped into regions r of equal mask sets,
//!
//! ```text
//! E_k = Σ_r a(k, r) V_r / Σ_r a(k, r) n_r     a(k, r) = Σ_{p in r} w(k, p)
//! V_r = Σ_{j covers r} e_j                    n_r = number of masks that cover r
//! ```
//!
//! so the field stays factorised: a sparse matrix of sums times a small matrix of region vectors.
//! Sums are taken in one canonical order (views by name, then regions), whatever order, thread or
//! process made them: the result is the same bit for bit.
//!
//! | step | job |
//! |---|---|
//! | [`sums`] | a view's sums in a file, ordered by cell |
//! | [`regroup`] | the sums of all views by Gaussian, a few cells at a time |
//! | [`refine`] | what masks count, and what neighbours add, where more than the plain average is asked for |
//! | [`embeddings`] | each Gaussian's embedding, computed once |
//! | [`field`] | what is kept of it: sums, total weight, length |

mod embeddings;
mod field;
pub mod photos;
pub mod published;
pub mod refine;
mod regroup;
mod sums;
mod table;
#[cfg(test)]
mod tests;

pub use field::{CellField, dot};
pub use refine::Aggregation;
pub use regroup::{Part, PartSums, RawGroup, SumsIndex};
pub use sums::{GAUSSIANS_PER_SLICE, MAX_REGIONS, SumEntry, SumsError, SumsFile, ViewRegions, ViewSums};
pub use table::RegionTable;

/// Returns whether values are ascending from 0 to `end`, as the starts of `starts.len() - 1` rows are.
fn are_starts(starts: &[u64], end: usize) -> bool {
    starts.first() == Some(&0) && starts.is_sorted() && starts.last() == Some(&(end as u64))
}
