//! Errors as problem details (RFC 9457).

use std::fmt;

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::{Map, Value, json};

/// The member of [`crate::params::ParameterMembers`] that names a parameter.
const PARAMETER: &str = "parameter";

/// The body of an error (RFC 9457).
#[derive(Serialize, JsonSchema)]
#[schemars(rename = "Problem")]
pub struct ProblemBody<M> {
    /// A URI that names the kind of error; it never changes its meaning.
    #[serde(rename = "type")]
    kind: String,
    /// The kind in words.
    title: &'static str,
    /// Status of the response.
    status: u16,
    /// This error in words, and what to do.
    detail: String,
    /// Path and number of the request, as in the log and in x-request-id.
    instance: String,
    #[serde(flatten)]
    members: M,
}

/// The members of problems that have none of their own.
#[derive(Serialize, JsonSchema)]
pub struct NoMembers {}

/// One error, as a client sees it.
///
/// A handler returns it; [`crate::request`] gives the response its body, so that it carries the request's id.
#[derive(Clone, Debug)]
pub struct Problem {
    status: StatusCode,
    kind: &'static str,
    title: &'static str,
    detail: String,
    members: Map<String, Value>,
    headers: Box<HeaderMap>,
    cause: Option<String>,
}

impl Problem {
    /// `kind` ends the problem's type URI; its meaning is stable.
    pub fn new(
        status: StatusCode,
        kind: &'static str,
        title: &'static str,
        detail: impl Into<String>,
    ) -> Self {
        let (members, headers) = (Map::new(), Box::default());
        Self { status, kind, title, detail: detail.into(), members, headers, cause: None }
    }

    /// Internal error: `cause` is logged, not returned.
    pub fn internal(cause: impl fmt::Display) -> Self {
        let detail = "the service failed; its log has the cause under the number of this request";
        let problem = Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", "Internal error", detail);
        Self { cause: Some(cause.to_string()), ..problem }
    }

    /// A request beyond a limit; it may succeed after `retry_secs`.
    pub fn overloaded(detail: impl Into<String>, retry_secs: u32) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "overloaded", "Overloaded", detail).retry_after(retry_secs)
    }

    /// An answer that took too long; the same request may succeed after `retry_secs`.
    pub fn timeout(detail: impl Into<String>, retry_secs: u32) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "timeout", "Timeout", detail).retry_after(retry_secs)
    }

    pub fn retry_after(self, seconds: u32) -> Self {
        self.with_header(header::RETRY_AFTER, seconds.into())
    }

    pub fn with_header(mut self, name: HeaderName, value: HeaderValue) -> Self {
        self.headers.insert(name, value);
        self
    }

    /// Adds members beyond RFC 9457, of the type named in the service's description.
    pub fn with(mut self, members: &impl Serialize) -> Self {
        if let Value::Object(members) = json!(members) {
            self.members.extend(members);
        }
        self
    }

    pub fn with_detail(self, detail: impl Into<String>) -> Self {
        Self { detail: detail.into(), ..self }
    }

    /// Returns the refused part of the request.
    pub fn parameter(&self) -> Option<&str> {
        self.members.get(PARAMETER)?.as_str()
    }

    /// Renames the refused part to its name in the request.
    pub fn rename_parameter(&mut self, name: &str) {
        if let Some(rest) = self.parameter().and_then(|old| self.detail.strip_prefix(old)?.strip_prefix(": "))
        {
            self.detail = format!("{name}: {rest}");
        }
        self.members.insert(PARAMETER.to_owned(), name.into());
    }

    pub(crate) fn cause(&self) -> Option<&str> {
        self.cause.as_deref()
    }

    /// Returns the problem of an error response without one, from a layer or the router. Services without a list of
    /// resources at `/` have their own for unknown paths.
    pub(crate) fn of_status(status: StatusCode, method: &str, path: &str) -> Self {
        let shown: String = path.chars().take(80).collect();
        match status {
            StatusCode::NOT_FOUND => {
                let detail = format!("there is nothing at {shown:?}; GET / lists the resources");
                Self::new(status, "not-found", "Not found", detail)
            }
            StatusCode::METHOD_NOT_ALLOWED => {
                let method: String = method.chars().take(20).collect();
                let detail =
                    format!("{shown:?} does not take {method:?}; the Allow header lists its methods");
                Self::new(status, "method-not-allowed", "Method not allowed", detail)
            }
            StatusCode::PAYLOAD_TOO_LARGE => {
                let detail = "the request's body is longer than this resource takes";
                Self::new(status, "body-too-large", "Body too large", detail)
            }
            StatusCode::SERVICE_UNAVAILABLE => {
                Self::timeout("the answer took too long; try again in a few seconds", 2)
            }
            _ => Self::new(status, "refused", "Refused", "the request could not be served"),
        }
    }

    /// Writes the body into a response made from this problem.
    pub(crate) fn render(self, response: Response, instance: String) -> Response {
        let (mut head, _) = response.into_parts();
        let body = ProblemBody {
            kind: format!("urn:slag:problem:{}", self.kind),
            title: self.title,
            status: self.status.as_u16(),
            detail: self.detail,
            instance,
            members: self.members,
        };
        for replaced in [header::CONTENT_LENGTH, header::TRANSFER_ENCODING] {
            head.headers.remove(replaced);
        }
        head.headers.extend(*self.headers);
        let content_type = HeaderValue::from_static("application/problem+json");
        head.headers.insert(header::CONTENT_TYPE, content_type);
        head.headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        Response::from_parts(head, json!(body).to_string().into())
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = self.status.into_response();
        response.extensions_mut().insert(self);
        response
    }
}
