//! The cloud side of SLAG as a library: one module per stage of the pipeline.

pub mod bench;
pub mod check;
pub mod cli;
pub mod demo;
pub mod embed;
pub mod encode;
pub mod eval;
pub mod generate;
pub mod ingest;
pub mod lift;
pub mod palette;
pub mod progress;
pub mod publish;
pub mod query;
pub mod raster;
pub mod segment;
pub mod shard;
pub mod store;
pub mod superpoint;
