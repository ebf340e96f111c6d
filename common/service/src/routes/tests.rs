use axum::body::{Body, Bytes, to_bytes};
use axum::http::{Request, StatusCode};
use serde::Deserialize;
use tower::ServiceExt;

use super::*;
use crate::openapi::About;
use crate::params::Params;
use crate::problem::NoMembers;
use crate::replies::As;

const ABOUT: About = About {
    name: "test",
    version: "1",
    license: "MIT",
    summary: "A service.",
    errors: &[(503, "Too busy.")],
};

/// The asker.
#[derive(Deserialize, JsonSchema)]
#[serde(default)]
struct Asker {
    /// Rank by distance too.
    #[schemars(example = &"1,2,3")]
    near: String,
}

impl Default for Asker {
    fn default() -> Self {
        Self { near: "0,0,0".into() }
    }
}

fn routes() -> Routes<()> {
    let found = async |Params(Asker { near }): Params<Asker>| {
        assert_eq!(near, "0,0,0");
        "found"
    };
    let route = Routes::default().get("/query", "things that match", found);
    route.post::<[u8; 3], _, _>("/position", "where the robot is", 4, async |body: Bytes| {
        As::<&'static str>::new(body)
    })
}

#[tokio::test]
async fn the_help_lists_what_the_router_serves() {
    let (router, table) = routes().described::<NoMembers>(ABOUT);
    let ask = async |method: &Method, path: &str, body: &'static str| {
        let request = Request::builder().method(method).uri(path).header("content-type", "application/json");
        let request = request.body(Body::from(body)).expect("a request");
        let response = router.clone().oneshot(request).await.expect("infallible");
        let status = response.status();
        (status, to_bytes(response.into_body(), 1 << 16).await.expect("whole"))
    };
    let (_, help) = ask(&Method::GET, "/", "").await;
    let help = std::str::from_utf8(&help).expect("text");
    let lines: Vec<Vec<&str>> =
        help.lines().map(|line| line.splitn(2, "  ").map(str::trim).collect()).collect();
    assert!(help.starts_with("A service.\n\nGET /query "), "{help}");
    for Route { method, path, summary, .. } in &table {
        assert_eq!(ask(method, path, "1 2").await.0, StatusCode::OK, "{method} {path}");
        assert!(lines.contains(&vec![format!("{method} {path}").as_str(), summary]), "{help}");
    }
    assert!(
        help.contains("\n    near=1,2,3  ") && help.contains(" Rank by distance too. Default: 0,0,0.\n"),
        "{help}"
    );
    assert_eq!(ask(&Method::POST, "/position", "1 2 3").await.0, StatusCode::PAYLOAD_TOO_LARGE);
}
