//! The laboratory: generated scenes whose contents are known, evaluation against labels, benchmarks, and the demo.
//!
//! Depends on the encoder; the encoder does not know of it.

pub mod bench;
pub mod cli;
pub mod demo;
pub mod eval;
pub mod generate;
