//! Network timeouts and retry limits.

use std::time::Duration;

/// Patience with a server and with the way to it.
#[derive(Clone, Debug)]
pub struct NetworkLimits {
    /// Failures in a row, without progress, after which a download is given up.
    pub attempts: u32,
    /// Wait after the first failure; doubled after each further one, and scaled by 0.5..1.5.
    pub first_backoff: Duration,
    /// Longest wait.
    pub longest_backoff: Duration,
    /// The longest wait that a server may ask for (`Retry-After`); it is waited beside the backoff.
    pub longest_retry_after: Duration,
    /// Time for name resolution and for connecting, each.
    pub connect_timeout: Duration,
    /// Time without a byte.
    pub read_timeout: Duration,
    /// A body that comes in slower than this on average is broken off (and resumed).
    pub slowest_bytes_per_sec: u64,
    /// Bytes received between two writes; a retry counts as progress after as many.
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
