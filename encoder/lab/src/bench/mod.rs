//! Benchmarks: each compares its candidates in one run and reports figures with the machine's name.

pub mod arrays;
pub mod codec;
pub mod field;
pub mod lift;
pub mod machine;
pub mod plot;
pub mod raster;
pub mod scene;
pub mod timing;
pub mod tradeoff;
