//! Benchmarks as commands: each writes JSON that names the machine and compares side by side in one run.

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
