//! Stage 4: contributions per (Gaussian, region) become embeddings.
//!
//! The paper's weighted average (Szilagyi et al. 2025, the equation for E_k) over all views i, masks
//! j and pixels p is, with the pixels grouped into regions r of equal mask sets,
//!
//! ```text
//! E_k = Σ_r a(k, r) V_r / Σ_r a(k, r) n_r     a(k, r) = Σ_{p in r} w(k, p)
//! V_r = Σ_{j covers r} e_j                    n_r = number of masks that cover r
//! ```
//!
//! so the field stays factorised: a sparse matrix of contributions times a small matrix of region vectors.
//! Sums are taken in one canonical order (views by name, then regions), whatever order, thread or
//! process made them: the result is the same bit for bit.
//!
//! | step | job |
//! |---|---|
//! | [`contributions`] | a view's contributions in a file, ordered by cell |
//! | [`transpose`] | the contributions of all views by Gaussian, a few cells at a time |
//! | [`refine`] | what masks count, and what neighbours add, where more than the plain average is asked for |
//! | [`embeddings`] | each Gaussian's embedding, computed once |
//! | [`field`] | what is kept of it: contributions, total weight, length |

mod contributions;
mod embeddings;
mod field;
pub mod photos;
pub mod published;
pub mod refine;
pub mod superpoint;
mod table;
#[cfg(test)]
mod tests;
mod transpose;

pub use contributions::{
    Contribution, ContributionError, ContributionFile, GAUSSIANS_PER_SLICE, MAX_REGIONS, ViewContributions,
    ViewRegions,
};
pub use field::CellField;
pub use refine::Aggregation;
pub use table::RegionTable;
pub use transpose::{ContributionIndex, Part, PartContributions, RawGroup};

/// Returns whether values are ascending from 0 to `end`, as the starts of `starts.len() - 1` rows are.
fn are_starts(starts: &[u64], end: usize) -> bool {
    starts.first() == Some(&0) && starts.is_sorted() && starts.last() == Some(&(end as u64))
}
