//! The cloud side of SLAG as a library: one module per stage of the pipeline.

pub mod publish;
pub mod segment;
pub mod store;
