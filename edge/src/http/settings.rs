//! Bounds of the service.

use std::time::Duration;

use slag_service::access::Access;
use slag_service::listener::ConnectionLimits;

/// Bounds of the service.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Bounds of the connections.
    pub connections: ConnectionLimits,
    /// Who may ask.
    pub access: Access,
    /// Queries in progress; further ones get 503.
    pub max_queries: usize,
    /// Time until an answer must begin, else 503.
    pub query_timeout: Duration,
    /// Time for sending a long answer.
    pub stream_timeout: Duration,
}

impl Default for Settings {
    fn default() -> Self {
        let connections = ConnectionLimits {
            n_connections: 512,
            n_per_peer: 384,
            stall_timeout: Duration::from_secs(60),
            drain_timeout: Duration::from_secs(5),
            ..ConnectionLimits::default()
        };
        Self {
            connections,
            access: Access::default(),
            max_queries: 32,
            query_timeout: Duration::from_secs(10),
            stream_timeout: Duration::from_secs(60),
        }
    }
}
