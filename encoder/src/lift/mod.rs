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

mod buckets;
mod field;
pub mod published;
mod sums;

pub use buckets::{CellBuckets, SumEntry};
pub use field::{CellField, FieldError, RegionTable, dot};
pub use sums::{SumsError, ViewSums};
