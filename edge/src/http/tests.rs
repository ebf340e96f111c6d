use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::extract::Request;
use axum::http::{HeaderMap, StatusCode};
use axum::response::Response;
use glam::DVec3;
use serde_json::{Value, json};
use slag_common::Hash32;
use slag_common::frames::{GeoReference, Geographic};
use slag_common::manifest::Manifest;
use slag_common::occupancy::BuiltOccupancy;
use slag_common::shard::Additions;
use slag_common::tuf::{Kept, SignedMetadata, Timestamp, generate_key, one_key_repository, sign};
use tempfile::TempDir;
use tower::ServiceExt;

use super::router::router;
use super::*;
use crate::fetch::follow::Following;
use crate::fetch::{Position, Records};
use crate::query::Engine;
use crate::store::{BadCell, CellFault, EdgeCache};
use crate::testing::{
    BuiltShard, CALIBRATION, Gate, Member, TestObject, TestShard, axes_service, manifest_of, open_gate,
    write_cache, write_manifest,
};
use openapi::{check, description};
use v1::room_with;

mod answers;
mod attacks;
mod changes;
mod goal;
mod list;
mod locate;
mod openapi;
mod ply;
mod v1;
mod view;

struct Service {
    dir: TempDir,
    app: Arc<App>,
    gate: Gate,
}

/// 20 Gaussians of axis 0 at x = 3, in a space of 3 axes.
fn chair(encoder_id: Option<Hash32>) -> [BuiltShard; 1] {
    let member = |i: u16| Member { steps: [i, 0, 0], embedding: vec![1.0, 0.0, 0.0] };
    let shard = TestShard::new(vec![(0..20).map(member).collect()]);
    let encoder_id = encoder_id.unwrap_or(shard.encoder_id);
    [TestShard { origin: DVec3::new(3.0, 0.0, 0.0), encoder_id, ..shard }.build(false)]
}

impl Service {
    /// Serves a cache with generation 1, or an empty one.
    fn new(shards: Option<&[BuiltShard]>, settings: Settings) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        if let Some(shards) = shards {
            write_cache(dir.path(), shards, 1);
        }
        let gate = Gate::default();
        let (text, _) = axes_service(3, Arc::clone(&gate));
        let engine = Engine::new(EdgeCache::open(dir.path()), text);
        assert_eq!(engine.reload().is_ok(), shards.is_some());
        Self { dir, app: App::new(engine, settings), gate }
    }

    fn with_chair() -> Self {
        Self::new(Some(&chair(None)), Settings::default())
    }

    fn send(&self, method: &str, uri: &str) -> impl Future<Output = Response> + use<> {
        let request = Request::builder().method(method).uri(uri).body(Body::empty()).expect("a request");
        let router = router(Arc::clone(&self.app));
        async move { router.oneshot(request).await.expect("infallible") }
    }

    async fn get(&self, uri: &str) -> Answered {
        soon(async { read(self.send("GET", uri).await).await }).await
    }

    /// Returns the body of an answer with status 200.
    async fn ok(&self, uri: &str) -> Value {
        let (status, _, body) = self.get(uri).await;
        assert_eq!(status, StatusCode::OK, "{uri}: {body:#}");
        body
    }

    async fn post(&self, uri: &str, kind: &str, body: impl Into<Body>) -> Answered {
        post(&self.app, uri, kind, body).await
    }
}

type Answered = (StatusCode, HeaderMap, Value);

async fn post(app: &Arc<App>, uri: &str, kind: &str, body: impl Into<Body>) -> Answered {
    let request = Request::post(uri).header("content-type", kind).body(body.into()).expect("a request");
    let router = router(Arc::clone(app));
    soon(async { read(router.oneshot(request).await.expect("infallible")).await }).await
}

fn assert_refused((status, _, body): &Answered, parameter: &str, asked: &str) {
    assert_eq!((status.as_u16(), &body["parameter"]), (400, &json!(parameter)), "{asked}: {body}");
}

/// A failed test must end, too: the runtime waits for every task at the gate.
impl Drop for Service {
    fn drop(&mut self) {
        open_gate(&self.gate);
    }
}

/// Fails instead of hanging.
async fn soon<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(20), future).await.expect("within 20 s")
}

async fn read(response: Response) -> Answered {
    let (head, body) = response.into_parts();
    let bytes = to_bytes(body, 1 << 20).await.expect("a body");
    let text = String::from_utf8_lossy(&bytes).into_owned();
    (head.status, head.headers, serde_json::from_slice(&bytes).unwrap_or(Value::String(text)))
}

async fn start(response: &mut std::pin::Pin<Box<impl Future<Output = Response>>>) {
    tokio::select! {
        biased;
        _ = response => panic!("must wait"),
        () = std::future::ready(()) => {}
    }
}

#[tokio::test]
async fn answers_questions() {
    let service = Service::with_chair();
    let (status, headers, body) = service.get("/query?text=0&near=3,0,4&radius=20&limit=5").await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(headers["content-type"], "application/json");
    let chair = &body["answers"][0];
    assert_eq!((&chair["rank"], &chair["id"], &chair["n_gaussians"]), (&1.into(), &"1-0".into(), &20.into()));
    assert!((chair["position_in_world"][0].as_f64().expect("a number") - 3.095).abs() < 1e-9);
    assert!((chair["distance"].as_f64().expect("a number") - 4.001).abs() < 1e-3);
    assert_eq!(body["scene"], "yard");
    assert_eq!(body["generation"], 1);
    assert_eq!(body["unit"], "m");
    let (_, _, gaussians) = service.get("/query?text=0&kind=gaussians&limit=3").await;
    assert_eq!(gaussians["answers"].as_array().map(Vec::len), Some(3));

    let (status, _, empty) = service.get("/query?text=1").await;
    assert_eq!((status, &empty["answers"]), (StatusCode::OK, &serde_json::json!([])));
    assert_eq!(empty["reason"]["kind"], "below-threshold");
    assert!(empty["reason"]["detail"].as_str().expect("text").contains("20 searched"));
}

#[tokio::test]
async fn refusals_are_problem_details() {
    let service = Service::with_chair();
    // By parameter: queries that are refused because of it.
    let cases = [
        (400, "text", " text= text=%20%09 text=%3F text=the text=%00%01%1b text=0&text="),
        (400, "negatives", "text=0&negatives=!!! text=0&negatives=1,,2 text=0&negatives=%07"),
        (
            400,
            "threshold",
            "text=0&threshold=NaN text=0&threshold=2 text=0&threshold= text=0&negatives=1&threshold=-0.1",
        ),
        (400, "near", "text=0&near=inf,0,0 text=0&near=0,0 text=0&radius=3"),
        (400, "radius", "text=0&near=0,0,0&radius=-1 text=0&near=0,0,0&radius=1e999"),
        (
            400,
            "limit",
            "text=0&limit=0 text=0&limit=-1 text=0&limit=99999999999999999999 text=0&limit=1&limit=2 text=0&limit=10001 \
             text=0&kind=gaussians&limit=1000001 text=0&kind=gaussians&text=1&limit=500001",
        ),
        (400, "kind", "text=0&kind=points text=0&format=arrow"),
        (400, "voxel", "text=0&voxel=0"),
        (400, "min_count", "text=0&min_count=0"),
        (400, "box", "text=0&box=1,2,3 text=0&box=0,0,0,1,1,NaN"),
        (400, "precision", "text=0&precision=maybe"),
        (400, "format", "text=0&format=xml"),
        (422, "negatives", "text=0&negatives=canonical"),
        (400, "offset", "text=0&offset=1"),
        (400, "colour", "text=0&colour=red"),
        (422, "text", "text=sofa"),
    ];
    let queries = |(status, parameter, queries): (u16, &'static str, &'static str)| {
        queries.split(' ').map(move |query| (status, parameter, query.to_owned())).collect::<Vec<_>>()
    };
    let long = format!("text={}", "x".repeat(10_000));
    for (status, parameter, query) in cases.into_iter().flat_map(queries).chain([(400, "text", long)]) {
        let uri = &format!("/query?{query}");
        let (found, headers, body) = service.get(uri).await;
        let shown: String = uri.chars().take(60).collect();
        assert_eq!(found.as_u16(), status, "{shown}: {body}");
        assert_eq!(headers["content-type"], "application/problem+json", "{shown}");
        assert_eq!(body["parameter"], parameter, "{shown}: {body}");
        assert_eq!(body["status"], status, "{shown}: {body}");
        for member in ["type", "title", "detail", "found", "expected"] {
            let holds = body[member].as_str().is_some_and(|text| !text.is_empty() && text.len() < 300);
            assert!(holds, "{shown}: {body}");
        }
    }
    let (_, _, unknown) = service.get("/query?text=sofa").await;
    assert_eq!(unknown["suggestions"], serde_json::json!(["0"]));
    let (status, headers, body) = service.get("/v1/manifest").await;
    assert_eq!((status.as_u16(), &body["type"]), (404, &"urn:slag:problem:not-found".into()));
    assert!(headers.contains_key("x-request-id"));
    let (status, headers, body) = read(service.send("POST", "/query?text=0").await).await;
    assert_eq!(status.as_u16(), 405);
    assert_eq!(headers["content-type"], "application/problem+json");
    assert_eq!((&headers["allow"], &body["status"]), (&"GET,HEAD".parse().expect("a value"), &405.into()));
}

#[tokio::test]
async fn without_a_scene_it_lives_but_is_not_ready() {
    let service = Service::new(None, Settings::default());
    assert_eq!(service.get("/healthz").await.0, StatusCode::OK);
    assert_eq!(service.get("/").await.0, StatusCode::OK);
    for uri in ["/readyz", "/query?text=0"] {
        let (status, headers, body) = service.get(uri).await;
        assert_eq!((status.as_u16(), &body["type"]), (503, &"urn:slag:problem:no-scene".into()));
        assert!(headers.contains_key("retry-after"));
    }
    let (status, _, body) = service.get("/status").await;
    assert_eq!((status, &body["is_ready"], &body["scene"]), (StatusCode::OK, &false.into(), &Value::Null));
}

/// The first question after the first fetch is answered, as the log promises.
#[tokio::test]
async fn the_first_scene_is_served_at_once() {
    let service = Service::new(None, Settings::default());
    assert_eq!(service.get("/query?text=0").await.0, StatusCode::SERVICE_UNAVAILABLE);
    write_cache(service.dir.path(), &chair(None), 1);
    let (status, _, body) = service.get("/query?text=0").await;
    assert_eq!((status, &body["generation"]), (StatusCode::OK, &1.into()), "{body}");
}

/// The client's own time limit gives an error without retry, unlike a slow service.
#[tokio::test]
async fn a_clients_own_time_is_its_own() {
    let service = Service::with_chair();
    let (status, headers, body) = service.get("/v1/query?text=wait&time_budget_ms=1").await;
    assert_eq!((status.as_u16(), &body["type"]), (504, &"urn:slag:problem:time-budget".into()), "{body}");
    assert!(!headers.contains_key("retry-after"));
    open_gate(&service.gate);
    assert_eq!(service.get("/v1/query?text=0&time_budget_ms=60000").await.0, StatusCode::OK);
}

#[tokio::test]
async fn another_encoder_is_refused_by_name() {
    let service = Service::new(Some(&chair(Some(Hash32([8; 32])))), Settings::default());
    let (status, _, body) = service.get("/query?text=0").await;
    assert_eq!((status.as_u16(), &body["type"]), (409, &"urn:slag:problem:encoder-mismatch".into()));
    assert_eq!(body["scene"]["id"], "08".repeat(32));
    assert!(body["detail"].as_str().expect("text").contains("--models"));
    assert_eq!(service.get("/readyz").await.0.as_u16(), 409);
    assert_eq!(service.get("/status").await.2["is_ready"], false);
}

#[tokio::test]
async fn too_many_questions_are_turned_away() {
    let service = Service::new(Some(&chair(None)), Settings { max_queries: 1, ..Settings::default() });
    let mut waiting = Box::pin(service.send("GET", "/query?text=wait"));
    start(&mut waiting).await;
    let (status, headers, body) = service.get("/query?text=0").await;
    assert_eq!((status.as_u16(), &body["type"]), (503, &"urn:slag:problem:overloaded".into()));
    assert_eq!(headers["retry-after"], "1");
    assert_eq!(service.get("/healthz").await.0, StatusCode::OK);
    open_gate(&service.gate);
    assert_eq!(waiting.await.status(), StatusCode::OK);
    assert_eq!(service.get("/query?text=0").await.0, StatusCode::OK);
}

/// A query that timed out keeps its permit until its work ends.
#[tokio::test]
async fn a_slow_answer_is_cut_off_and_keeps_its_place() {
    let settings =
        Settings { max_queries: 1, query_timeout: Duration::from_millis(1), ..Settings::default() };
    let service = Service::new(Some(&chair(None)), settings);
    let (status, headers, body) = service.get("/query?text=wait").await;
    assert_eq!((status.as_u16(), &body["type"]), (503, &"urn:slag:problem:timeout".into()));
    assert!(headers.contains_key("retry-after"));
    assert_eq!(service.get("/query?text=0").await.2["type"], "urn:slag:problem:overloaded");
    open_gate(&service.gate);
    let _permit = service.app.permits.acquire().await.expect("never closed");
}

#[tokio::test]
async fn our_own_faults_are_not_explained_to_clients() {
    let service = Service::with_chair();
    let (status, _, body) = service.get("/query?text=panic").await;
    assert_eq!((status.as_u16(), &body["type"]), (500, &"urn:slag:problem:internal".into()));
    assert!(!body.to_string().contains("text model"));
    assert_eq!(service.get("/readyz").await.0.as_u16(), 500);
}

/// The request that notices a new generation loads it in the background; a broken one changes nothing.
#[tokio::test]
async fn generations_are_swapped_while_questions_are_answered() {
    let service = Service::with_chair();
    let reloaded = async |line: &str| {
        while !service.get("/metrics").await.2.as_str().expect("text").contains(line) {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    assert_eq!(service.get("/query?text=0").await.2["generation"], 1);
    write_cache(service.dir.path(), &chair(None), 2);
    let (status, _, body) = service.get("/query?text=0").await;
    assert!(status == StatusCode::OK && [1, 2].contains(&body["generation"].as_i64().expect("a number")));
    soon(reloaded("slag_edge_reloads_total 1\n")).await;
    assert_eq!(service.get("/query?text=0").await.2["generation"], 2);

    fs_err::write(service.dir.path().join("current"), b"{").expect("a file");
    assert_eq!(service.get("/status").await.2["scene"]["generation"], 2);
    soon(reloaded("slag_edge_reload_failures_total 1\n")).await;
    assert_eq!(service.get("/query?text=0").await.2["generation"], 2);
}

#[tokio::test]
async fn tells_status_and_metrics() {
    let service = Service::with_chair();
    service.get("/query?text=0").await;
    service.get("/query?text=1").await;
    service.get("/query?text=0&limit=x").await;
    service.get("/nowhere").await;
    let (_, _, status) = service.get("/status").await;
    assert_eq!((&status["is_ready"], &status["error"]), (&true.into(), &Value::Null));
    assert_eq!(status["text_model"]["name"], "axes");
    assert_eq!(status["text_model"]["execution_provider"], "none");
    let scene = &status["scene"];
    assert_eq!(scene["n_gaussians"], 20);
    assert_eq!(scene["encoder_name"], "axes");
    assert_eq!(scene["metric"], true);
    assert_eq!((&scene["shards"][0]["cell_id"], &scene["radius"]), (&1.into(), &50.0.into()));
    let (_, headers, metrics) = service.get("/metrics").await;
    assert!(headers["content-type"].to_str().expect("text").starts_with("text/plain"));
    let metrics = metrics.as_str().expect("text");
    for line in [
        "slag_edge_http_requests_total{route=\"/query\",status=\"200\"} 2",
        "slag_edge_http_requests_total{route=\"/query\",status=\"400\"} 1",
        "slag_edge_http_requests_total{route=\"other\",status=\"404\"} 1",
        "slag_edge_query_duration_seconds_bucket{le=\"+Inf\"} 3",
        "slag_edge_query_duration_seconds_count 3",
        "slag_edge_empty_answers_total 1",
        "slag_edge_generation 1",
        "slag_edge_gaussians 20",
    ] {
        assert!(metrics.lines().any(|found| found == line), "{line} is not in\n{metrics}");
    }
}

/// The scene answers whatever the store's timestamp says.
#[tokio::test]
async fn an_expired_scene_answers_and_the_status_says_so() {
    for (expires_unix_secs, is_expired) in [(1, true), (4_000_000_000, false)] {
        let service = Service::with_chair();
        keep_timestamp(service.dir.path(), expires_unix_secs);
        let (_, _, body) = service.get("/status").await;
        assert_eq!(body["is_expired"], is_expired);
        assert_eq!(body["expires_unix_secs"], expires_unix_secs);
        assert_eq!(body["is_ready"], true);
        let (_, _, map) = service.get("/v1/map").await;
        assert_eq!(map["is_expired"], is_expired);
        assert_eq!(map["expires_unix_secs"], expires_unix_secs);
        let (status, _, body) = service.get("/query?text=0").await;
        assert_eq!((status, &body["answers"][0]["n_gaussians"]), (StatusCode::OK, &20.into()));
    }
}

fn keep_timestamp(dir: &std::path::Path, expires_unix_secs: u64) {
    let key = generate_key();
    let files = one_key_repository(&key, 1, "manifest", b"");
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).expect("JSON");
    let mut kept = Kept::from_root(&files["1.root.json"]).expect("a root");
    let body = SignedMetadata::<Timestamp>::parse("timestamp", &files["timestamp.json"]).expect("sound").body;
    kept.timestamp = Some(text(&sign(1, expires_unix_secs, &body, &[&key])));
    let cache = EdgeCache::open(dir);
    Records::open(&cache).expect("opens").keep(&cache, &kept).expect("kept");
}

#[tokio::test]
async fn positions_are_handed_on_or_refused() {
    let service = Service::with_chair();
    let say =
        async |app: &Arc<App>, body: &str| post(app, "/position", "application/json", body.to_owned()).await;
    let (status, _, body) = say(&service.app, "1 2 3").await;
    assert_eq!((status.as_u16(), &body["type"]), (409, &"urn:slag:problem:not-following".into()));
    assert_eq!(service.get("/status").await.2["following"], Value::Null);

    let following = Arc::<Following>::default();
    let (text, _) = axes_service(3, Gate::default());
    let engine = Engine::new(EdgeCache::open(service.dir.path()), text);
    let app = App::following(engine, Settings::default(), Some(Arc::clone(&following)));
    assert_eq!(say(&app, r#"{"x":1,"y":-2,"z":3.5}"#).await.0, StatusCode::ACCEPTED);
    assert_eq!(following.status().position, Some(Position::World(DVec3::new(1.0, -2.0, 3.5))));
    assert_eq!(say(&app, r#"{"lat":46.8,"lon":-92}"#).await.0, StatusCode::ACCEPTED);
    let at = Position::Geographic { latitude_deg: 46.8, longitude_deg: -92.0, height_m: None };
    assert_eq!(following.status().position, Some(at));
    for bad in [
        "",
        "{}",
        r#"{"x":1}"#,
        r#"{"x":1e300,"y":0,"z":0}"#,
        r#"{"lat":91,"lon":0}"#,
        r#"{"lat":46.8,"lon":-92,"height":1e300}"#,
        "\u{1b}[2J",
        &"1".repeat(900),
    ] {
        assert_refused(&say(&app, bad).await, "body", bad);
    }
    // The scene on board has no place on the earth: nothing is read as degrees.
    app.reload_now();
    for degrees in ["3,2,0", r#"{"lat":46.8,"lon":-92}"#] {
        assert_refused(&say(&app, degrees).await, "body", degrees);
    }
    let (_, _, body) = say(&app, "here").await;
    assert!(body["expected"].as_str().is_some_and(|forms| forms.contains("`x y z`")), "{body:#}");
    let (status, _, body) = say(&app, &"1".repeat(100_000)).await;
    assert_eq!((status.as_u16(), &body["type"]), (413, &"urn:slag:problem:body-too-large".into()));
    assert_eq!(following.status().position, Some(at), "what is refused changes nothing");
}
