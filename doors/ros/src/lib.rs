//! A robot's answers on ROS 2 topics and services without a ROS installation: a DDS node before `slag-edge serve`.

mod answers;
mod args;
mod geometry;
mod ground;
mod locator;
mod messages;
mod navigation;
pub mod node;
mod position;
mod stand;
mod transforms;

pub use args::Args;
