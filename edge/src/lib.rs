//! The robot's side of SLAG: keeps the shards around it and answers text queries offline.

pub mod cli;
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

pub use slag_common::error_line;

/// Returns the time in seconds since 1970; 0 if the clock is earlier.
pub fn now_unix_secs() -> u64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_secs())
}
