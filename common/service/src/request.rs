//! The stage around every request: its id, its log line, its counter, and the body of an error.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use axum::Router;
use axum::extract::{MatchedPath, Request, State};
use axum::http::HeaderValue;
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use tower_http::catch_panic::CatchPanicLayer;

use crate::metrics::ResponseCounts;
use crate::problem::Problem;

/// The label of paths that are no route: a scanner must not fill the metrics.
const OTHER: &str = "other";

struct Observer {
    n_requests: AtomicU64,
    responses: Arc<ResponseCounts>,
}

/// Puts this stage around a router: ids in `x-request-id`, a problem as the body of every error (a panic
/// of a handler is one), counts in `responses`.
pub fn observed(router: Router, responses: Arc<ResponseCounts>) -> Router {
    let observer = Arc::new(Observer { n_requests: AtomicU64::new(0), responses });
    router.layer(CatchPanicLayer::custom(panicked)).layer(from_fn_with_state(observer, observe))
}

async fn observe(State(observer): State<Arc<Observer>>, request: Request, next: Next) -> Response {
    let started = Instant::now();
    let id = observer.n_requests.fetch_add(1, Ordering::Relaxed) + 1;
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let matched = request.extensions().get::<MatchedPath>().cloned();
    let mut response = next.run(request).await;
    let status = response.status();
    if status.is_client_error() || status.is_server_error() {
        let problem = response.extensions_mut().remove::<Problem>();
        let problem = problem.unwrap_or_else(|| Problem::of_status(status, method.as_str(), &path));
        if let Some(cause) = problem.cause() {
            tracing::error!(id, %method, path, "{cause}");
        }
        response = problem.render(response, format!("{path}#request-{id}"));
    }
    let route = matched.as_ref().map_or(OTHER, MatchedPath::as_str);
    observer.responses.count(route, status.as_u16());
    tracing::debug!(id, %method, route, status = status.as_u16(), took = ?started.elapsed(), "request");
    response.headers_mut().insert("x-request-id", HeaderValue::from(id));
    response
}

fn panicked(panic: Box<dyn Any + Send>) -> Response {
    let text = panic.downcast_ref::<&str>().copied().or(panic.downcast_ref::<String>().map(String::as_str));
    Problem::internal(format!("a handler panicked: {}", text.unwrap_or("without a message"))).into_response()
}

#[cfg(test)]
mod tests;
