//! Shared parts of the encoder's and the robot's HTTP services.
//!
//! A request passes these stages in order, each with its checks:
//!
//! | stage | where | what is decided there |
//! |---|---|---|
//! | accept | [`listener`] | number of connections, in all, for each peer, and for health alone |
//! | bytes | [`connection`], [`tls`] | time without progress, for idle clients, slow requests and slow readers alike |
//! | head | [`listener`] | length of the request head, and time for it |
//! | request | [`request`], [`access`] | id, log line, counters, error body; `Host`, `Origin`, bearer token, CORS |
//! | route | [`routes`] | path and method; type and length of a request body, and time for it |
//! | handler | [`params`], the service's own | parameters, admission of expensive work, the answer |
//!
//! [`openapi`] describes routes and types, [`replies`] handlers' results; [`listen`] has addresses, [`problem`] error
//! bodies, [`range`] byte ranges and entity tags, [`metrics`] Prometheus' text format, [`stop`] the signals to stop.

pub mod access;
mod body;
pub mod connection;
pub mod listen;
pub mod listener;
pub mod metrics;
pub mod openapi;
pub mod params;
mod permits;
pub mod problem;
pub mod range;
pub mod replies;
pub mod request;
pub mod routes;
pub mod stop;
pub mod tls;
