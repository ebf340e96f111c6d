//! Network timeouts and retry limits.

use std::time::Duration;

/// Network timeouts and retry limits.
#[derive(Clone, Debug)]
pub struct NetworkLimits {
    /// Failures in a row, without progress, before a download is given up.
    pub attempts: u32,
    /// Wait after the first failure; doubled after each further one, and scaled by 0.5..1.5.
    pub first_backoff: Duration,
    /// Longest wait.
    pub longest_backoff: Duration,
    /// Longest `Retry-After` accepted; it is added to the backoff.
    pub longest_retry_after: Duration,
    /// Timeout for name resolution and for connecting, each.
    pub connect_timeout: Duration,
    /// Longest time without a byte.
    pub read_timeout: Duration,
    /// Downloads slower than this on average are interrupted (and resumed).
    pub slowest_bytes_per_sec: u64,
    /// Bytes between two writes; a retry that gained as many counts as progress.
    pub chunk_bytes: usize,
}

impl Default for NetworkLimits {
    fn default() -> Self {
        Self {
            attempts: 6,
            first_backoff: Duration::from_millis(500),
            longest_backoff: Duration::from_secs(30),
            longest_retry_after: Duration::from_secs(120),
            connect_timeout: Duration::from_secs(10),
            read_timeout: Duration::from_secs(20),
            slowest_bytes_per_sec: 4096,
            chunk_bytes: 256 << 10,
        }
    }
}
