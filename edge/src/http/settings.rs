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
    /// Clients of `GET /v1/events`; further ones get 503.
    pub max_listeners: usize,
    /// Time until an answer must begin, else 503; and what a query may compute for.
    pub query_timeout: Duration,
    /// Memory that a query may use; one that needs more gets 422.
    pub query_bytes: u64,
    /// Memory that all queries in progress may use; one that exceeds it gets 503.
    pub all_queries_bytes: u64,
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
            max_listeners: 32,
            query_timeout: Duration::from_secs(10),
            query_bytes: 256 << 20,
            all_queries_bytes: 1 << 30,
            stream_timeout: Duration::from_secs(60),
        }
    }
}
