//! The accept loop: bounded connections, deadlines for requests and answers, and a graceful stop with a deadline.

use std::io;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use axum::Router;
use axum::body::Body;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::{GracefulShutdown, Watcher};
use hyper_util::service::TowerToHyperService;

use crate::body::TimedBody;
use crate::connection::Stalling;
use crate::listen::{Listener, Stream};
use crate::permits::{Permit, Permits, Reserved};
use crate::tls::Tls;

/// Pause after a failed accept. Out of file descriptors, an immediate retry would only burn CPU.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Longest time for the request on a reserved connection, and for sending its answer.
const RESERVED_TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Open connections. Further ones get one answer: 503, except for health, readiness and metrics.
    pub n_connections: usize,
    /// Open connections per peer: an IPv4 address, or a /64 network of IPv6.
    pub n_per_peer: usize,
    /// Open connections beyond these limits; another one ends the oldest.
    pub n_reserved: usize,
    /// Length of a request head; longer ones get 431.
    pub head_bytes: usize,
    /// Time for a request head, for the TLS handshake before it, and for idling.
    pub head_timeout: Duration,
    /// Time for a request body, from the end of its head; slower ones get 408.
    pub body_timeout: Duration,
    /// Time without sending progress after which a connection is dropped ([`Stalling`]). Should exceed the sum of
    /// `head_timeout`, `body_timeout` and the service's own time for an answer.
    pub stall_timeout: Duration,
    /// Time for requests in progress after the signal to stop.
    pub drain_timeout: Duration,
}

impl Default for ConnectionLimits {
    /// Limits for a machine with a few cores, below the usual 1024 open files.
    fn default() -> Self {
        Self {
            n_connections: 768,
            n_per_peer: 512,
            n_reserved: 32,
            // Ten times the longest sensible query of the robot's service.
            head_bytes: 16 << 10,
            head_timeout: Duration::from_secs(10),
            body_timeout: Duration::from_secs(5),
            stall_timeout: Duration::from_secs(30),
            drain_timeout: Duration::from_secs(10),
        }
    }
}

/// Serves until `stop` completes, then lets requests in progress finish within the drain deadline.
///
/// # Errors
/// [`io::ErrorKind::TimedOut`] when the deadline cut requests off.
pub async fn serve(
    router: Router,
    listener: impl Into<Listener>,
    limits: ConnectionLimits,
    stop: impl Future<Output = ()>,
) -> io::Result<()> {
    let listener = listener.into();
    let tls = listener.tls.clone();
    let permits = Permits::new(limits.n_connections, limits.n_per_peer, limits.n_reserved);
    let graceful = GracefulShutdown::new();
    let mut stop = std::pin::pin!(stop);
    loop {
        let accepted = tokio::select! {
            () = &mut stop => break,
            accepted = listener.accept() => accepted,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!("a connection was not accepted: {error}");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let permit = permits.admit(peer);
        tokio::spawn(converse(router.clone(), stream, tls.clone(), permit, limits, graceful.watcher()));
    }
    drop(listener);
    let drained = tokio::time::timeout(limits.drain_timeout, graceful.shutdown()).await;
    drained.map_err(|_| {
        let after = limits.drain_timeout.as_secs_f64();
        let what = format!("requests still in progress {after} s after the stop were cut off");
        io::Error::new(io::ErrorKind::TimedOut, what)
    })
}

async fn converse(
    router: Router,
    stream: Box<dyn Stream>,
    tls: Option<Tls>,
    mut permit: Permit,
    limits: ConnectionLimits,
    watcher: Watcher,
) {
    let is_reserved = permit.is_reserved();
    let at_most = |timeout: Duration| if is_reserved { timeout.min(RESERVED_TIMEOUT) } else { timeout };
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |request: Request<Incoming>| {
        let (head, body) = request.into_parts();
        let body = Body::new(TimedBody::new(body, &head.headers, limits.body_timeout));
        let mut request = Request::from_parts(head, body);
        if is_reserved {
            request.extensions_mut().insert(Reserved);
        }
        router.call(request)
    });
    let stream = Stalling::new(stream, at_most(limits.stall_timeout));
    let handshake = async {
        let stream: Box<dyn Stream> = match tls {
            Some(tls) => Box::new(tls.0.accept(stream).await?),
            None => Box::new(stream),
        };
        Ok::<_, io::Error>(stream)
    };
    let stream = tokio::select! {
        shaken = tokio::time::timeout(at_most(limits.head_timeout), handshake) => match shaken {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => return tracing::debug!("a TLS handshake failed: {error}"),
            Err(_) => return tracing::debug!("a TLS handshake took too long"),
        },
        () = permit.ended() => return tracing::debug!("a connection made room for another"),
    };
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        // A client may say that it has asked all (`nc -N`), and wait for the answer.
        .half_close(true)
        .auto_date_header(is_of_a_date(SystemTime::now()))
        .keep_alive(!is_reserved)
        .header_read_timeout(at_most(limits.head_timeout))
        .max_buf_size(limits.head_bytes)
        .serve_connection(TokioIo::new(stream), service);
    tokio::select! {
        ended = watcher.watch(connection) => {
            if let Err(error) = ended {
                tracing::debug!("a connection ended: {error}");
            }
        }
        () = permit.ended() => tracing::debug!("a connection made room for another"),
    }
}

/// The first second after the year 9999.
const YEAR_10000_UNIX_SECS: u64 = 253_402_300_800;

/// Returns whether the Date header can express a time; hyper panics on others.
fn is_of_a_date(now: SystemTime) -> bool {
    now.duration_since(UNIX_EPOCH).is_ok_and(|since| since.as_secs() < YEAR_10000_UNIX_SECS)
}

#[cfg(test)]
mod tests;
