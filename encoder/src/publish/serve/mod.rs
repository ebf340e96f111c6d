//! The HTTP service that robots fetch from.
//!
//! `GET /` lists the resources. The service needs no lock on the store; a `stat` for each request notices a
//! new manifest.

mod cells;
mod objects;
mod problem;
mod router;
mod state;

use slag_service::listen::{Listen, ListenError, bind};
use slag_service::listener;
use slag_service::tls::Tls;

pub use router::bounded;
pub(crate) use router::router;
pub use slag_service::access::Access;
pub(crate) use slag_service::access::AccessSettings;
pub use state::Limits;

/// Serves until `shutdown` completes, then lets answers finish within the drain deadline. `on_listening` gets the
/// address to connect to, `http://IP:PORT` (`https` with TLS) or `unix:PATH`; for port 0 the system chooses the port.
///
/// # Errors
/// Fails if the address cannot be listened on.
pub async fn serve(
    router: axum::Router,
    listen: Listen,
    limits: Limits,
    tls: Option<Tls>,
    on_listening: impl FnOnce(String),
    shutdown: impl Future<Output = ()>,
) -> Result<(), ListenError> {
    let listener = bind(&listen).await?.with_tls(tls);
    on_listening(listener.url().map_err(|cause| ListenError { address: listen, cause })?);
    if let Err(cut_off) = listener::serve(router, listener, limits.connections, shutdown).await {
        // A robot resumes its download at the next start.
        tracing::warn!("{cut_off}");
    }
    Ok(())
}

#[cfg(test)]
mod tests;
