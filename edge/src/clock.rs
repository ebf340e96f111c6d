//! The system's clock.

/// Returns the system's clock, seconds since 1970; 0 where it stands before that.
pub fn now_unix_secs() -> u64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_secs())
}
