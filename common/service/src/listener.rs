//! The accept loop: a bounded number of connections, bounded request heads, a stop with a deadline.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use crate::connection::Stalling;

/// Pause after a failed accept. Out of file descriptors, an immediate retry would only burn the CPU.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Bounds of a service's connections.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Open connections; further ones wait in the system's queue.
    pub n_connections: usize,
    /// Length of a request head; a longer one is answered with 431.
    pub head_bytes: usize,
    /// Time for a request head, and time that a connection may idle.
    pub head_timeout: Duration,
    /// Time without a byte sent after which a connection is dropped ([`Stalling`]). It should exceed the
    /// sum of `head_timeout` and the service's own time for an answer.
    pub stall_timeout: Duration,
    /// Time for requests in progress after the signal to stop.
    pub drain_timeout: Duration,
}

impl Default for ConnectionLimits {
    /// Returns bounds for a machine with a few cores.
    fn default() -> Self {
        Self {
            n_connections: 1024,
            // Ten times the longest sensible query of the robot's service.
            head_bytes: 16 << 10,
            head_timeout: Duration::from_secs(20),
            stall_timeout: Duration::from_secs(30),
            drain_timeout: Duration::from_secs(10),
        }
    }
}

/// The address that a service cannot listen on.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen on {address}: {cause}; choose another address or port")]
pub struct ListenError {
    /// The address.
    pub address: SocketAddr,
    /// The system's error.
    pub cause: io::Error,
}

/// The drain deadline passed before all requests were answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("requests still in progress {} s after the stop were cut off", after.as_secs_f64())]
pub struct CutOff {
    /// The deadline.
    pub after: Duration,
}

impl From<CutOff> for io::Error {
    fn from(error: CutOff) -> Self {
        Self::new(io::ErrorKind::TimedOut, error)
    }
}

/// Starts listening; with port 0 the system chooses the port.
///
/// # Errors
/// [`ListenError`].
pub async fn bind(address: SocketAddr) -> Result<TcpListener, ListenError> {
    TcpListener::bind(address).await.map_err(|cause| ListenError { address, cause })
}

/// Serves until `stop` completes, then lets requests in progress finish within the drain deadline.
///
/// # Errors
/// [`CutOff`] when the deadline ended requests.
pub async fn serve(
    router: Router,
    listener: TcpListener,
    limits: ConnectionLimits,
    stop: impl Future<Output = ()>,
) -> Result<(), CutOff> {
    let service = TowerToHyperService::new(router);
    let connections = Arc::new(Semaphore::new(limits.n_connections));
    let graceful = GracefulShutdown::new();
    let mut stop = std::pin::pin!(stop);
    loop {
        let accepting = async {
            // The semaphore is never closed.
            let permit = Arc::clone(&connections).acquire_owned().await;
            (permit, listener.accept().await)
        };
        let (permit, accepted) = tokio::select! {
            () = &mut stop => break,
            accepted = accepting => accepted,
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!("a connection was not accepted: {error}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        // Otherwise an answer in two pieces may wait 40 ms for the acknowledgement of the first.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!("TCP_NODELAY is not set on a connection: {error}");
        }
        let connection = http1::Builder::new()
            .timer(TokioTimer::new())
            .header_read_timeout(limits.head_timeout)
            .max_buf_size(limits.head_bytes)
            .serve_connection(TokioIo::new(Stalling::new(stream, limits.stall_timeout)), service.clone());
        let connection = graceful.watch(connection);
        tokio::spawn(async move {
            let _permit = permit;
            if let Err(error) = connection.await {
                tracing::debug!("a connection ended: {error}");
            }
        });
    }
    drop(listener);
    let drained = tokio::time::timeout(limits.drain_timeout, graceful.shutdown()).await;
    drained.map_err(|_| CutOff { after: limits.drain_timeout })
}

#[cfg(test)]
mod tests;
