//! Errors as problem details (RFC 9457): `application/problem+json`, from one place.

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde_json::{Map, Value, json};
use slag_models::EncodeError;

use crate::query::{QueryError, RequestError};
use crate::text::TextError;

/// What a client should wait after a refusal for lack of room.
const RETRY_AFTER_SECS: u32 = 1;

/// One error, as it is sent.
#[derive(Clone, Debug)]
pub struct Problem {
    status: StatusCode,
    kind: &'static str,
    title: &'static str,
    detail: String,
    retry_after: bool,
    members: Map<String, Value>,
}

impl Problem {
    /// Makes a problem; `kind` ends its type URI.
    pub fn new(
        status: StatusCode,
        kind: &'static str,
        title: &'static str,
        detail: impl Into<String>,
    ) -> Self {
        Self { status, kind, title, detail: detail.into(), retry_after: false, members: Map::new() }
    }

    /// Says that the same request may succeed soon.
    pub fn retry(mut self) -> Self {
        self.retry_after = true;
        self
    }

    fn with(mut self, member: &str, value: impl Into<Value>) -> Self {
        self.members.insert(member.to_owned(), value.into());
        self
    }

    /// Our own fault: the detail goes to the log, not to the client.
    pub fn internal(error: &dyn std::fmt::Display) -> Self {
        tracing::error!("a request failed: {error}");
        let detail = "the service failed; its log says why";
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", "Internal error", detail)
    }

    /// No such path.
    pub fn not_found(path: &str) -> Self {
        let path: String = path.chars().take(80).collect();
        let detail = format!("there is nothing at {path:?}; GET / lists what there is");
        Self::new(StatusCode::NOT_FOUND, "not-found", "Not found", detail)
    }

    /// Another method than the path's.
    pub fn method_not_allowed(method: &str) -> Self {
        let method: String = method.chars().take(20).collect();
        let detail = format!("found {method:?}, expected \"GET\", or \"POST\" at /position");
        Self::new(StatusCode::METHOD_NOT_ALLOWED, "method-not-allowed", "Method not allowed", detail)
    }

    /// As many questions as there may be are being answered.
    pub fn overloaded(limit: usize) -> Self {
        let detail = format!("{limit} queries are being answered, the limit; ask again");
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "overloaded", "Overloaded", detail).retry()
    }

    /// The answer took too long.
    pub fn timeout(limit: std::time::Duration) -> Self {
        let detail =
            format!("no answer within {} s; ask for a smaller radius, or again", limit.as_secs_f64());
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "timeout", "Timeout", detail).retry()
    }
}

impl From<RequestError> for Problem {
    fn from(error: RequestError) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter", error.to_string())
            .with("parameter", error.parameter)
            .with("found", error.found)
            .with("expected", error.expected)
    }
}

impl From<QueryError> for Problem {
    fn from(error: QueryError) -> Self {
        let (kind, detail) = (error.kind(), error.to_string());
        let unavailable =
            |title| Self::new(StatusCode::SERVICE_UNAVAILABLE, kind, title, detail.clone()).retry();
        let parameter = if matches!(error, QueryError::Negatives(_)) { "negatives" } else { "text" };
        let unknown_words = |found: String, expected: String, suggestions: Vec<String>| {
            Self::new(StatusCode::UNPROCESSABLE_ENTITY, kind, "Unknown words", detail.clone())
                .with("parameter", parameter)
                .with("found", found)
                .with("expected", expected)
                .with("suggestions", suggestions)
        };
        match error {
            QueryError::Request(error) => error.into(),
            QueryError::NoScene => unavailable("No scene"),
            QueryError::Text(TextError::Busy) | QueryError::Negatives(TextError::Busy) => {
                unavailable("Overloaded")
            }
            QueryError::EncoderMismatch { models_name, models_id, scene_name, scene_id } => {
                Self::new(StatusCode::CONFLICT, kind, "Text model and scene do not fit", detail)
                    .with("models", json!({ "name": models_name, "id": models_id }))
                    .with("scene", json!({ "name": scene_name, "id": scene_id }))
            }
            QueryError::Text(TextError::Encode(error)) | QueryError::Negatives(TextError::Encode(error)) => {
                match error {
                    EncodeError::EmptyText => {
                        RequestError::new(parameter, "nothing to look for", "words to look for").into()
                    }
                    EncodeError::UnknownPhrase { text, n_known, near } => {
                        unknown_words(text, format!("one of {n_known} phrases"), near)
                    }
                    EncodeError::UnknownWords { unknown, known } => {
                        unknown_words(unknown.join(", "), "words that the model knows".into(), known)
                    }
                    _ => Self::internal(&detail),
                }
            }
            QueryError::Text(TextError::Stopped)
            | QueryError::Negatives(TextError::Stopped)
            | QueryError::Score(_) => Self::internal(&detail),
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut body = self.members;
        body.insert("type".into(), format!("urn:slag:problem:{}", self.kind).into());
        body.insert("title".into(), self.title.into());
        body.insert("status".into(), self.status.as_u16().into());
        body.insert("detail".into(), self.detail.into());
        let content_type = HeaderValue::from_static("application/problem+json");
        let mut response =
            (self.status, [(header::CONTENT_TYPE, content_type)], Value::Object(body).to_string())
                .into_response();
        if self.retry_after {
            response.headers_mut().insert(header::RETRY_AFTER, RETRY_AFTER_SECS.into());
        }
        response
    }
}
