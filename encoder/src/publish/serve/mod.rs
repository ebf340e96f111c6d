//! The HTTP service that robots fetch from.
//!
//! `GET /` lists the resources. The service needs no lock on the store; a `stat` for each request notices a
//! new manifest.

mod cells;
mod limits;
mod metadata;
mod objects;
mod problem;
mod router;
mod state;

use std::path::Path;

use slag_service::listen::{Listen, ListenError, bind};
use slag_service::listener;
use slag_service::tls::Tls;

use crate::store::StoreError;
pub use limits::Limits;
pub use router::router;
pub use slag_service::access::{Access, AccessSettings};

/// Why the service does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The address cannot be listened on.
    #[error(transparent)]
    Listen(#[from] ListenError),
}

/// Serves a store until `shutdown` completes, then lets answers in progress finish within the drain deadline.
///
/// `on_listening` gets the address to connect to, `http://IP:PORT` (`https` with TLS) or `unix:PATH`: the system chooses the port if
/// `listen` has port 0.
///
/// # Errors
/// [`ServeError`]; a store without a published scene is one.
pub async fn serve(
    dir: &Path,
    listen: impl Into<Listen>,
    limits: Limits,
    access: Access,
    tls: Option<Tls>,
    on_listening: impl FnOnce(String),
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServeError> {
    let (router, listen) = (router(dir, limits, access)?, listen.into());
    let listener = bind(&listen).await?.with_tls(tls);
    on_listening(listener.url().map_err(|cause| ListenError { address: listen, cause })?);
    if let Err(cut_off) = listener::serve(router, listener, limits.connections, shutdown).await {
        // A robot continues its download at the next start.
        tracing::warn!("{cut_off}");
    }
    Ok(())
}

#[cfg(test)]
mod tests;
