//! The page that draws a scene, queries it and shows the answers. `scripts/build-page.sh` builds it from `web/` into
//! `dist/`; the build embeds it compressed, and [`router`] serves it under `/view` without network or files.
//!
//! The serving program sends the scene ([`Description`]), Gaussians ([`cell_message`]) and scores ([`ScoresMessage`])
//! in the layouts of `docs/view.md`.

mod cell;
mod description;
mod scores;

use std::io::Read;

use axum::Router;
use axum::http::header::{
    ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG,
    IF_NONE_MATCH, REFERRER_POLICY, VARY, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use slag_service::params::PathText;
use slag_service::problem::Problem;

pub use cell::{CELL_HEAD_BYTES, GAUSSIAN_BYTES, Step, cell_message};
pub use description::{Cell, CellState, Corners, Description, Fetched, Photo, Word, Words};
pub use scores::ScoresMessage;

struct File {
    /// Path below `/view/`.
    path: &'static str,
    /// Changes with the content; quoted.
    etag: &'static str,
    gzip: &'static [u8],
}

/// Empty if the page was not built.
static FILES: &[File] = include!(concat!(env!("OUT_DIR"), "/files.rs"));

const POLICY: &str = include_str!("csp.txt");

const NOT_BUILT: &str =
    "this program was built without its page; run scripts/build-page.sh and build the program again";

pub fn is_built() -> bool {
    !FILES.is_empty()
}

pub fn router<S: Clone + Send + Sync + 'static>() -> Router<S> {
    Router::new()
        .route("/view", get(async |headers: HeaderMap| reply("index.html", &headers)))
        .route("/view/", get(async |headers: HeaderMap| reply("index.html", &headers)))
        .route(
            "/view/{*path}",
            get(async |PathText(path): PathText, headers: HeaderMap| reply(&path, &headers)),
        )
}

fn content_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        "wasm" => "application/wasm",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

fn reply(path: &str, headers: &HeaderMap) -> Response {
    if !is_built() {
        let status = StatusCode::SERVICE_UNAVAILABLE;
        return Problem::new(status, "no-page", "No page", NOT_BUILT).into_response();
    }
    let Some(file) = FILES.iter().find(|file| file.path == path) else {
        let shown: String = path.chars().take(80).collect();
        let detail = format!("the page has no file {shown:?}; reload it");
        return Problem::new(StatusCode::NOT_FOUND, "not-found", "Not found", detail).into_response();
    };
    // Names under assets/ contain a hash of the content.
    let caching =
        if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" };
    let common = [
        (ETAG, HeaderValue::from_static(file.etag)),
        (CACHE_CONTROL, HeaderValue::from_static(caching)),
        (CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY.trim_ascii())),
        (X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff")),
        (REFERRER_POLICY, HeaderValue::from_static("no-referrer")),
        (VARY, HeaderValue::from_static("accept-encoding")),
    ];
    let header = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok()).unwrap_or("");
    if header(IF_NONE_MATCH).split(',').any(|tag| tag.trim().trim_start_matches("W/") == file.etag) {
        return (StatusCode::NOT_MODIFIED, common).into_response();
    }
    let content = [(CONTENT_TYPE, content_type(path))];
    if header(ACCEPT_ENCODING)
        .split(',')
        .any(|coding| coding.split(';').next().is_some_and(|c| c.trim() == "gzip"))
    {
        return (common, content, [(CONTENT_ENCODING, "gzip")], file.gzip).into_response();
    }
    let mut plain = Vec::new();
    match flate2::read::GzDecoder::new(file.gzip).read_to_end(&mut plain) {
        Ok(_) => (common, content, plain).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use axum::http::Request;
    use tower::ServiceExt;

    use super::*;

    async fn fetch(path: &str, header: Option<(&str, &str)>) -> Response {
        let mut request = Request::get(path);
        if let Some((name, value)) = header {
            request = request.header(name, value);
        }
        router::<()>().oneshot(request.body(Body::empty()).expect("a request")).await.expect("never fails")
    }

    #[tokio::test]
    async fn page_is_served_or_says_how_to_build_it() {
        let index = fetch("/view", None).await;
        if !is_built() {
            assert_eq!(index.status(), StatusCode::SERVICE_UNAVAILABLE);
            return;
        }
        assert_eq!(index.status(), StatusCode::OK);
        assert!(!index.headers()[CONTENT_SECURITY_POLICY].to_str().expect("ASCII").contains("unsafe-inline"));
        let etag = index.headers()[ETAG].to_str().expect("ASCII").to_owned();
        assert_eq!(fetch("/view/", Some(("if-none-match", &etag))).await.status(), StatusCode::NOT_MODIFIED);
        assert_eq!(fetch("/view/no-such-file", None).await.status(), StatusCode::NOT_FOUND);
        let packed = fetch("/view", Some(("accept-encoding", "br, gzip"))).await;
        assert_eq!(packed.headers()[CONTENT_ENCODING], "gzip");
    }
}
