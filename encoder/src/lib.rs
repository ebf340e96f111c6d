//! The cloud side of SLAG as a library: one module per stage of the pipeline.

pub mod cells;
pub mod check;
pub mod cli;
pub mod codebook;
pub mod embed;
pub mod encode;
pub mod ingest;
pub mod lift;
pub mod masks;
pub mod objects;
pub mod progress;
pub mod publish;
pub mod query;
pub mod raster;
pub mod segment;
pub mod shard;
pub mod store;
