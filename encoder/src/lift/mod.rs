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
//! Contributions are summed in one canonical order (views by name, then regions), whatever made them, so the result
//! is the same bit for bit.

mod contributions;
mod embeddings;
pub mod field;
mod index;
mod passes;
pub mod photos;
pub(crate) mod refine;
pub(crate) mod superpoint;
mod table;
#[cfg(test)]
mod tests;

pub use contributions::{Contribution, ContributionError, ContributionFile, ViewContributions};
pub use field::CellField;
pub use index::{ContributionIndex, Part, PartContributions};
pub(crate) use passes::SceneContributions;
pub use refine::Aggregation;
pub use table::RegionTable;
