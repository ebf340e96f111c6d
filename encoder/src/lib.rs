//! The cloud side of SLAG as a library: one module per stage of the pipeline.

pub mod embed;
pub mod segment;
