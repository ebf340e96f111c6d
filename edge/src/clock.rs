//! The system's clock.

/// Returns the current time, seconds since 1970; 0 if the clock is set before that.
pub fn now_unix_secs() -> u64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_secs())
}
