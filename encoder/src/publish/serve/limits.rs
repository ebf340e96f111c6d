//! Bounds of the service.

use std::time::Duration;

use slag_service::listener::ConnectionLimits;

/// Bounds of the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Bounds of the connections.
    pub connections: ConnectionLimits,
    /// Requests in progress; further ones get 503.
    pub n_requests: usize,
    /// Objects being sent; further ones get 503.
    pub n_downloads: usize,
    /// Time until an answer must begin, else 503.
    pub answer_timeout: Duration,
}

impl Default for Limits {
    /// Returns bounds for a machine with a few cores: 64 downloads in pieces take 4 MiB.
    fn default() -> Self {
        Self {
            connections: ConnectionLimits::default(),
            n_requests: 128,
            n_downloads: 64,
            answer_timeout: Duration::from_secs(10),
        }
    }
}
