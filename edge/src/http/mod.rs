//! The robot's own HTTP service: questions, status, health and metrics.

mod app;
mod ask;
mod follower;
mod forms;
mod metrics;
mod position;
mod problem;
mod query;
mod router;
mod scrub;
mod settings;
mod status;
mod v1;

pub use app::App;
pub use follower::{RESTARTS, keep_following};
pub use query::parse_query;
pub use router::serve;
pub use scrub::keep_scrubbing;
pub use settings::Settings;

#[cfg(test)]
mod tests;
