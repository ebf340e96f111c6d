//! The laboratory: generated scenes with known contents, evaluation against labels, benchmarks, and the demo.
//!
//! It depends on the encoder, never the other way round.

#[cfg(feature = "measure")]
pub mod bench;
pub mod cli;
pub mod demo;
#[cfg(feature = "measure")]
pub mod eval;
pub mod generate;
