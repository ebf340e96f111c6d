//! `bench robot`: the paper's table of query times on the robot, with other engines on the same vectors in the same run.
//!
//! A generated field of each size is published, fetched over loopback and queried by `slag-edge`, as on a robot. The other
//! engines (`edge/benches/rivals`) get the same vectors and queries, each in a process of its own, so that the memory of
//! one is not counted for the next. One oracle judges all answers: float64 products of the vectors.

mod engine;
mod measure;
mod page;
mod report;
#[cfg(test)]
mod tests;
mod truth;

pub use engine::Engine;
pub use measure::{RobotSettings, run};
pub use report::RobotReport;
