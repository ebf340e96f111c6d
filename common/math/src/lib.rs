//! Numerical building blocks shared by the encoder and the robot.
//!
//! Sums run in a fixed order whatever the vector width, and results do not depend on the number of threads: every
//! function returns the same bits on every machine. Exceptions are relevancies and normal numbers, which take `exp`,
//! `ln` and `cos` from the system's library.

pub mod axes;
pub mod cholesky;
pub mod distance_transform;
mod dot;
pub mod eigen;
pub mod graph_segmentation;
pub mod matrix;
pub mod nearest;
pub mod random;
pub mod relevancy;
pub mod simd;
pub mod stats;
pub mod union_find;

pub use dot::{dot, dot_f64};
