use axum::body::{Body, to_bytes};
use axum::http::{Method, StatusCode, header};
use axum::routing::get;
use serde_json::Value;
use tower::ServiceExt;

use super::*;
use crate::metrics::Exposition;
use crate::params::PathText;

async fn broken() {
    panic!("secret of the house");
}

async fn refused() -> Problem {
    Problem::overloaded("come back later", 7).with(&serde_json::json!({ "limit": 3 }))
}

fn router(responses: &Arc<ResponseCounts>) -> Router {
    let routes = Router::new()
        .route("/things/{name}", get(async |PathText(_): PathText| "a thing"))
        .route("/broken", get(broken))
        .route("/refused", get(refused));
    observed(routes, Arc::clone(responses), Access::default())
}

async fn ask(router: &Router, method: Method, path: &str) -> (Response, Value) {
    let request = Request::builder().method(method).uri(path).body(Body::empty()).expect("a request");
    let (head, body) = router.clone().oneshot(request).await.expect("infallible").into_parts();
    let body = to_bytes(body, 1 << 16).await.expect("whole");
    (Response::from_parts(head, Body::empty()), serde_json::from_slice(&body).unwrap_or(Value::Null))
}

#[tokio::test]
async fn every_error_is_a_problem_with_the_id_of_its_request() {
    let responses = Arc::default();
    let router = router(&responses);
    let cases = [
        (Method::GET, "/nowhere", 404, "not-found", "\"/nowhere\""),
        (Method::POST, "/things/chair", 405, "method-not-allowed", "does not take \"POST\""),
        (
            Method::GET,
            "/things/%ff",
            400,
            "bad-parameter",
            "name: found \"/things/%ff\", expected text in UTF-8",
        ),
        (Method::GET, "/broken", 500, "internal", "the service failed"),
        (Method::GET, "/refused", 503, "overloaded", "come back later"),
    ];
    for (at, (method, path, status, kind, detail)) in cases.into_iter().enumerate() {
        let (response, problem) = ask(&router, method, path).await;
        assert_eq!(response.status().as_u16(), status, "{path}");
        assert_eq!(response.headers()[header::CONTENT_TYPE], "application/problem+json");
        assert_eq!(response.headers()[header::CACHE_CONTROL], "no-store");
        let id = (at + 1).to_string();
        assert_eq!(response.headers()["x-request-id"], id.as_str());
        assert_eq!(problem["instance"], format!("{path}#request-{id}"));
        assert_eq!(problem["type"], format!("urn:slag:problem:{kind}"));
        assert_eq!(problem["status"], status);
        assert!(problem["detail"].as_str().expect("text").contains(detail), "{problem}");
        assert!(!problem.to_string().contains("secret"), "{problem}");
    }
    let (response, problem) = ask(&router, Method::GET, "/refused").await;
    assert_eq!(response.headers()[header::RETRY_AFTER], "7");
    assert_eq!(problem["limit"], 3);
}

/// Paths with parameters count as their route, all unknown paths as one.
#[tokio::test]
async fn responses_are_counted_by_route() {
    let responses = Arc::default();
    let router = router(&responses);
    for path in ["/things/a", "/things/b", "/x", "/y"] {
        let (response, _) = ask(&router, Method::GET, path).await;
        assert_eq!(response.status() == StatusCode::OK, path.starts_with("/things"));
    }
    let mut text = Exposition::new("test");
    text.responses(&responses);
    for line in [
        "test_http_requests_total{route=\"/things/{name}\",status=\"200\"} 2",
        "test_http_requests_total{route=\"other\",status=\"404\"} 2",
    ] {
        assert!(text.as_str().lines().any(|found| found == line), "{line} is not in\n{}", text.as_str());
    }
}
