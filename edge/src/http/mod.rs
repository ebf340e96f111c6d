//! The robot's own HTTP service: questions, status, health and metrics.

mod app;
mod ask;
mod follower;
mod forms;
mod position;
mod problem;
mod query;
mod router;
mod status;
mod v1;

pub use app::{App, Settings};
pub use follower::{RESTARTS, keep_following, keep_scrubbing};
pub use query::parse_query;
pub use router::serve;

#[cfg(test)]
mod tests;
