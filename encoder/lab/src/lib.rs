//! The laboratory: generated scenes with known contents, evaluation against labels, benchmarks, and the demo.
//!
//! It depends on the encoder and the robot, never the other way round.

#[cfg(feature = "measure")]
mod bench;
pub mod cli;
mod demo;
#[cfg(feature = "measure")]
mod eval;
pub mod generate;
#[cfg(feature = "measure")]
mod harness;
mod programs;
#[cfg(feature = "measure")]
mod scenes;
#[cfg(feature = "measure")]
mod table;
