//! Benchmarks: each compares its candidates in one run and reports figures with the machine's name.

pub mod arrays;
pub mod codec;
pub mod field;
pub mod fleet;
pub mod inference;
pub mod lift;
pub mod machine;
pub mod partition;
pub mod plot;
pub mod programs;
pub mod raster;
pub mod robot;
pub mod scene;
pub mod timing;
pub mod tradeoff;
