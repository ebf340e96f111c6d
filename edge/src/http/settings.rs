//! Bounds of the service.

use std::time::Duration;

use slag_service::access::Access;
use slag_service::listener::ConnectionLimits;

/// Time for a request and for sending its answer, besides that for the query.
const STALL_BEYOND_QUERY: Duration = Duration::from_secs(50);

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

impl Settings {
    /// Returns bounds for a machine with a few cores, with a budget of memory and time for each query. All queries
    /// together may use four times the memory.
    pub(crate) fn with_budget(query_bytes: u64, query_timeout: Duration) -> Self {
        let connections = ConnectionLimits {
            n_connections: 512,
            n_per_peer: 384,
            stall_timeout: query_timeout + STALL_BEYOND_QUERY,
            drain_timeout: Duration::from_secs(5),
            ..ConnectionLimits::default()
        };
        Self {
            connections,
            access: Access::default(),
            max_queries: 32,
            max_listeners: 32,
            query_timeout,
            query_bytes,
            all_queries_bytes: query_bytes.saturating_mul(4),
            stream_timeout: Duration::from_secs(60),
        }
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self::with_budget(256 << 20, Duration::from_secs(10))
    }
}
