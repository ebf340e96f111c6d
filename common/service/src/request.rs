//! The stage around every request: its id, access check, log line, counter, and error body.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use axum::Router;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use tower_http::catch_panic::CatchPanicLayer;

use crate::access::Access;
use crate::metrics::ResponseCounts;
use crate::permits::{HEALTH_PATHS, Reserved};
use crate::problem::Problem;

/// Label of unknown paths: a scanner must not fill the metrics.
const OTHER: &str = "other";

const REQUEST_ID: &str = "x-request-id";
/// Longest id accepted from a client.
const MAX_ID_CHARS: usize = 64;
/// `Retry-After` when there are too many connections.
const RETRY_SECS: u32 = 1;

struct Observer {
    n_requests: AtomicU64,
    responses: Arc<ResponseCounts>,
    access: Access,
}

/// Wraps a router: ids in `x-request-id` (the client's own if sent), the checks of `access`, a problem as the body of
/// every error (including handlers' panics), counts in `responses`.
pub fn observed(router: Router, responses: Arc<ResponseCounts>, access: Access) -> Router {
    let observer = Arc::new(Observer { n_requests: AtomicU64::new(0), responses, access });
    router.layer(CatchPanicLayer::custom(panicked)).layer(from_fn_with_state(observer, observe))
}

async fn observe(State(observer): State<Arc<Observer>>, request: Request, next: Next) -> Response {
    let started = Instant::now();
    let number = observer.n_requests.fetch_add(1, Ordering::Relaxed) + 1;
    let id = id_of(request.headers()).unwrap_or_else(|| number.to_string());
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let reader = observer.access.reader(request.headers());
    let mut response = match admitted(&observer.access, &request) {
        Ok(()) => match observer.access.preflight(&request) {
            Some(response) => response,
            None => next.run(request).await,
        },
        Err(problem) => problem.into_response(),
    };
    let status = response.status();
    if status.is_client_error() || status.is_server_error() {
        let problem = response.extensions_mut().remove::<Problem>();
        let problem = problem.unwrap_or_else(|| Problem::of_status(status, method.as_str(), &path));
        if let Some(cause) = problem.cause() {
            tracing::error!(%id, %method, path, "{cause}");
        }
        response = problem.render(response, format!("{path}#request-{id}"));
    }
    let route = matched.as_ref().map_or(OTHER, MatchedPath::as_str);
    observer.responses.count(route, status.as_u16());
    tracing::debug!(%id, %method, route, status = status.as_u16(), took = ?started.elapsed(), "request");
    // An id is visible ASCII, so it is a valid header value.
    if let Ok(id) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    if let Some(origin) = reader {
        Access::allow(&mut response, origin);
    }
    response
}

/// Returns the client's request id, if it is a short word.
fn id_of(headers: &HeaderMap) -> Option<String> {
    let id = headers.get(REQUEST_ID)?.to_str().ok()?;
    let is_word = id.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b));
    (is_word && (1..=MAX_ID_CHARS).contains(&id.len())).then(|| id.to_owned())
}

/// Checks access, and on a reserved connection the path.
fn admitted(access: &Access, request: &Request) -> Result<(), Problem> {
    access.check(request)?;
    if request.extensions().get::<Reserved>().is_some() && !HEALTH_PATHS.contains(&request.uri().path()) {
        let detail = "too many connections are open, in all or from this address; close some, or try again";
        return Err(Problem::overloaded(detail, RETRY_SECS));
    }
    Ok(())
}

fn panicked(panic: Box<dyn Any + Send>) -> Response {
    Problem::internal(format!("a handler panicked: {}", panic_text(&*panic))).into_response()
}

/// Returns what a panic said.
pub fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied().or(panic.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("without a message")
}

#[cfg(test)]
mod tests;
