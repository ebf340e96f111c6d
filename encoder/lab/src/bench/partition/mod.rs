//! `bench partition`: what a robot downloads, and how long that takes, by the radius it asks for and the size of cells.
//!
//! Small cells fit the circle around the robot, but each has a codebook of its own and costs a request; large cells share
//! codebooks, but much of them lies outside the circle.

mod link;
mod measure;
mod report;
mod site;
#[cfg(test)]
mod tests;

pub use link::LinkSpeed;
pub use measure::{PartitionSettings, run};
pub use report::PartitionReport;
