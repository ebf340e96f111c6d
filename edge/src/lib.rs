//! The robot's side of SLAG: keeps the shards around it and answers text queries offline.

pub mod cli;
mod clock;
pub mod fetch;
pub mod goal;
pub mod http;
pub mod locate;
pub mod query;
pub mod score;
pub mod store;
#[cfg(test)]
mod testing;
pub mod text;

pub use clock::now_unix_secs;
pub use slag_common::error_line;
