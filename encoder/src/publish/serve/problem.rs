//! Errors of the service as `application/problem+json` (RFC 9457), rendered in one place.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde_json::json;

use crate::publish::geographic::GeographicError;

/// Why a request gets no answer.
#[derive(Clone, Debug, thiserror::Error)]
pub(super) enum ApiError {
    /// A parameter is missing, superfluous or out of range.
    #[error("{0}")]
    Parameters(String),
    /// The store does not publish this.
    #[error("{0} is not published here; fetch the manifest again, it lists what is")]
    NotFound(String),
    /// The scene has no place on the earth, so the resource does not exist in its state.
    #[error("{0}")]
    NotGeoReferenced(GeographicError),
    /// No byte of the range is there.
    #[error("no byte of the range is there; the object has {len_bytes} bytes")]
    Range {
        /// The object's length.
        len_bytes: u64,
    },
    /// As much is under way as the limits allow.
    #[error("the server is at its limit; try again in a few seconds")]
    Busy,
    /// Our fault: told to the log, not to the client.
    #[error("{0}")]
    Internal(String),
}

impl ApiError {
    fn status(&self) -> StatusCode {
        match self {
            Self::Parameters(_) => StatusCode::BAD_REQUEST,
            Self::NotFound(_) => StatusCode::NOT_FOUND,
            Self::NotGeoReferenced(_) => StatusCode::CONFLICT,
            Self::Range { .. } => StatusCode::RANGE_NOT_SATISFIABLE,
            Self::Busy => StatusCode::SERVICE_UNAVAILABLE,
            Self::Internal(_) => StatusCode::INTERNAL_SERVER_ERROR,
        }
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let mut response = self.status().into_response();
        if let Self::Range { len_bytes } = self
            && let Ok(value) = HeaderValue::from_str(&format!("bytes */{len_bytes}"))
        {
            response.headers_mut().insert(header::CONTENT_RANGE, value);
        }
        response.extensions_mut().insert(self);
        response
    }
}

/// Seconds after which a client that was turned away should come back.
const RETRY_AFTER_SECS: u32 = 2;

/// Middleware: gives every error response, whoever made it, a problem body, and logs what is ours.
pub(super) async fn render(
    State(n_requests): State<Arc<AtomicU64>>,
    request: Request,
    next: Next,
) -> Response {
    let number = n_requests.fetch_add(1, Ordering::Relaxed);
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let response = next.run(request).await;
    let status = response.status();
    if !status.is_client_error() && !status.is_server_error() {
        return response;
    }
    let error = response.extensions().get::<ApiError>().cloned();
    let detail = match &error {
        Some(ApiError::Internal(cause)) => {
            tracing::error!(request = number, %method, path, "{cause}");
            "the server failed; its log says why, under this number".to_owned()
        }
        Some(error) => error.to_string(),
        None => by_status(status).to_owned(),
    };
    let problem = json!({
        "type": "about:blank",
        "title": status.canonical_reason().unwrap_or("Error"),
        "status": status.as_u16(),
        "detail": detail,
        "instance": format!("{path}#request-{number}"),
    });
    let mut headers = response.headers().clone();
    for replaced in [header::CONTENT_LENGTH, header::CONTENT_TYPE, header::TRANSFER_ENCODING] {
        headers.remove(replaced);
    }
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if status == StatusCode::SERVICE_UNAVAILABLE {
        headers.insert(header::RETRY_AFTER, RETRY_AFTER_SECS.into());
    }
    (status, headers, problem.to_string()).into_response()
}

/// Says what happened where a layer below made the response.
fn by_status(status: StatusCode) -> &'static str {
    match status {
        StatusCode::NOT_FOUND => "there is no such resource; /v1/manifest is where to start",
        StatusCode::METHOD_NOT_ALLOWED => "this resource can only be read: GET or HEAD",
        StatusCode::PAYLOAD_TOO_LARGE => "this service takes no request bodies",
        StatusCode::SERVICE_UNAVAILABLE => "the answer took too long; try again in a few seconds",
        _ => "the request could not be served",
    }
}
