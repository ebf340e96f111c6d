//! The errors of this service.

use axum::http::{HeaderValue, StatusCode, header};
use slag_service::problem::Problem;

/// Delay after which a request beyond a limit may succeed.
const RETRY_SECS: u32 = 2;

pub(super) fn bad_parameter(detail: impl Into<String>) -> Problem {
    Problem::new(StatusCode::BAD_REQUEST, "bad-parameter", "Bad parameter", detail)
}

pub(super) fn not_published(what: &str) -> Problem {
    let detail = format!("{what} is not published here; fetch the manifest again, it lists the objects");
    Problem::new(StatusCode::NOT_FOUND, "not-found", "Not found", detail)
}

/// Without a place on the earth, the resource does not exist in the scene's current state.
pub(super) fn not_geo_referenced(detail: String) -> Problem {
    Problem::new(StatusCode::CONFLICT, "not-geo-referenced", "Scene is not geo-referenced", detail)
}

pub(super) fn range_not_satisfiable(len_bytes: u64) -> Problem {
    let detail = format!("no byte of the range is there; the object has {len_bytes} bytes");
    let (status, kind) = (StatusCode::RANGE_NOT_SATISFIABLE, "range-not-satisfiable");
    let problem = Problem::new(status, kind, "Range not satisfiable", detail);
    match HeaderValue::from_str(&format!("bytes */{len_bytes}")) {
        Ok(value) => problem.with_header(header::CONTENT_RANGE, value),
        Err(_) => problem,
    }
}

pub(super) fn busy() -> Problem {
    Problem::overloaded("the server is at its limit; try again in a few seconds", RETRY_SECS)
}
