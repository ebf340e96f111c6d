//! Benchmarks: each compares its candidates in one run and reports figures with the machine's name.

mod embeddings;
mod field;
pub(crate) mod query;
pub(crate) mod raster;
pub(crate) mod robot;
pub(crate) mod tradeoff;
