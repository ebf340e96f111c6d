use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, to_bytes};
use axum::http::{HeaderMap, HeaderName, Request, StatusCode, header};
use axum::routing::get;
use glam::DVec3;
use serde_json::Value;
use slag_common::Hash32;
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::Manifest;
use tower::ServiceExt;

use super::*;
use crate::store::tests::{manifest, manifest_of_boxes, new_store};
use crate::store::{Extras, Store, StoreError, StoreReader};

/// A store with generations 1 (shards 0 and 1) and 2 (shards 1 and 2), and all shards' bytes.
struct Fixture {
    dir: tempfile::TempDir,
    store: Store,
    shards: Vec<(Hash32, Vec<u8>)>,
    extra: Hash32,
}

fn fixture() -> Fixture {
    let (dir, store) = new_store();
    let content =
        |seed: u32| (0..200_000u32).map(|i| (i.wrapping_mul(2_654_435_761 + seed) >> 24) as u8).collect();
    let shards: Vec<(Hash32, Vec<u8>)> = (0..3)
        .map(|seed| {
            let bytes: Vec<u8> = content(seed);
            (store.put_bytes(&bytes).expect("room").0, bytes)
        })
        .collect();
    let extra = store.put_bytes(b"not for robots").expect("room").0;
    let extras = Extras::from([("field".to_owned(), extra)]);
    let fixture = Fixture { dir, store, shards, extra };
    for generation in [1, 2] {
        let listed = fixture.listed(generation - 1..generation + 1);
        fixture.store.publish(&manifest(generation as u64, &listed), &extras).expect("publishes");
    }
    fixture
}

fn served() -> (Fixture, Router) {
    let fixture = fixture();
    let router = fixture.router_within(Limits::default()).expect("published");
    (fixture, router)
}

impl Fixture {
    fn listed(&self, range: std::ops::Range<usize>) -> Vec<(Hash32, u64)> {
        self.shards[range].iter().map(|(hash, bytes)| (*hash, bytes.len() as u64)).collect()
    }

    /// Target name of the manifest, from the metadata.
    fn manifest_sha256(&self) -> String {
        let targets = fs_err::read(self.dir.path().join("metadata/2.targets.json")).expect("there");
        let targets: Value = serde_json::from_slice(&targets).expect("JSON");
        targets["signed"]["targets"]["manifest"]["hashes"]["sha256"].as_str().expect("text").to_owned()
    }

    fn router_within(&self, limits: Limits) -> Result<Router, StoreError> {
        router(self.dir.path(), limits, Access::default(), Router::new())
    }
}

struct Answer {
    status: StatusCode,
    headers: HeaderMap,
    body: Bytes,
}

impl Answer {
    fn header(&self, name: HeaderName) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().expect("ASCII"))
    }

    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    /// Checks that this is a problem of RFC 9457; returns its detail.
    fn problem(&self, status: StatusCode) -> String {
        assert_eq!(self.status, status);
        assert_eq!(self.header(header::CONTENT_TYPE), "application/problem+json");
        let problem = self.json();
        assert!(problem["type"].as_str().expect("text").starts_with("urn:slag:problem:"));
        assert_eq!(problem["status"], status.as_u16());
        assert!(!problem["title"].as_str().expect("text").is_empty());
        assert!(problem["instance"].as_str().expect("text").contains("#request-"));
        problem["detail"].as_str().expect("text").to_owned()
    }
}

async fn ask(router: &Router, request: Request<Body>) -> Answer {
    let response = router.clone().oneshot(request).await.expect("infallible");
    let (parts, body) = response.into_parts();
    let body = to_bytes(body, usize::MAX).await.expect("whole");
    Answer { status: parts.status, headers: parts.headers, body }
}

fn request(path: &str, headers: &[(&str, &str)]) -> Request<Body> {
    let mut request = Request::get(path);
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    request.body(Body::empty()).expect("a request")
}

async fn get_with(router: &Router, path: &str, headers: &[(&str, &str)]) -> Answer {
    ask(router, request(path, headers)).await
}

#[tokio::test]
async fn manifest_is_tagged() {
    let (_fixture, router) = served();
    let answer = get_with(&router, "/v1/manifest", &[]).await;
    assert_eq!(answer.status, StatusCode::OK);
    assert_eq!(Manifest::parse(&answer.body).expect("a manifest").generation, 2);
    let tag = answer.header(header::ETAG).to_owned();
    assert_eq!(tag, format!("\"{}\"", Hash32::of(&answer.body)));
    for (condition, status) in [
        (tag.clone(), StatusCode::NOT_MODIFIED),
        (format!("\"other\", W/{tag}"), StatusCode::NOT_MODIFIED),
        ("\"other\"".to_owned(), StatusCode::OK),
    ] {
        let answer = get_with(&router, "/v1/manifest", &[("if-none-match", &condition)]).await;
        assert_eq!((answer.status, answer.header(header::ETAG)), (status, tag.as_str()), "{condition}");
        assert_eq!(answer.body.is_empty(), status == StatusCode::NOT_MODIFIED);
    }
}

#[tokio::test]
async fn objects_in_whole_and_in_part() {
    let (fixture, router) = served();
    // Only the previous manifest lists shard 0.
    for (hash, bytes) in &fixture.shards {
        let answer = get_with(&router, &format!("/v1/objects/{hash}"), &[]).await;
        assert_eq!((answer.status, &answer.body[..]), (StatusCode::OK, &bytes[..]));
        assert_eq!(answer.header(header::ETAG), format!("\"{hash}\""));
        assert_eq!(answer.header(header::CACHE_CONTROL), "public, max-age=31536000, immutable");
        assert_eq!(answer.header(header::ACCEPT_RANGES), "bytes");
        assert_eq!(answer.header(header::CONTENT_LENGTH), bytes.len().to_string());
    }
    let (hash, bytes) = &fixture.shards[2];
    let (path, tag, n) = (format!("/v1/objects/{hash}"), format!("\"{hash}\""), bytes.len());
    let weak = format!("W/{tag}");
    for (range, condition, part) in [
        ("bytes=0-0", None, Some(0..1)),
        ("bytes=65535-65537", None, Some(65_535..65_538)),
        ("bytes=199999-", Some(tag.as_str()), Some(n - 1..n)),
        ("bytes=-70000", Some(tag.as_str()), Some(n - 70_000..n)),
        ("bytes=5-1000000", None, Some(5..n)),
        ("bytes=5-9", Some("\"another\""), None),
        ("bytes=5-9", Some(weak.as_str()), None),
        ("bytes=5-9", Some("Wed, 21 Oct 2015 07:28:00 GMT"), None),
        ("bytes=0-1,4-5", None, None),
        ("lines=1-2", None, None),
    ] {
        let mut headers = vec![("range", range)];
        headers.extend(condition.map(|tag| ("if-range", tag)));
        let answer = get_with(&router, &path, &headers).await;
        let what = format!("{range} {condition:?}");
        match part {
            Some(part) => {
                assert_eq!(answer.status, StatusCode::PARTIAL_CONTENT, "{what}");
                let expected = format!("bytes {}-{}/{n}", part.start, part.end - 1);
                assert_eq!(answer.header(header::CONTENT_RANGE), expected, "{what}");
                assert_eq!(answer.header(header::CONTENT_LENGTH), part.len().to_string(), "{what}");
                assert_eq!(&answer.body[..], &bytes[part], "{what}");
            }
            None => assert_eq!((answer.status, answer.body.len()), (StatusCode::OK, n), "{what}"),
        }
    }
    let answer = get_with(&router, &path, &[("range", "bytes=200000-")]).await;
    assert!(answer.problem(StatusCode::RANGE_NOT_SATISFIABLE).contains("200000 bytes"));
    assert_eq!(answer.header(header::CONTENT_RANGE), "bytes */200000");

    let answer = get_with(&router, &path, &[("if-none-match", &tag), ("range", "bytes=0-1")]).await;
    assert_eq!((answer.status, answer.body.len()), (StatusCode::NOT_MODIFIED, 0));
    let head = Request::head(&path).header("range", "bytes=0-1").body(Body::empty()).expect("a request");
    let answer = ask(&router, head).await;
    assert_eq!((answer.status, answer.body.len()), (StatusCode::OK, 0));
    assert_eq!(answer.header(header::CONTENT_LENGTH), "200000");
}

#[tokio::test]
async fn only_what_is_listed_is_served() {
    let (fixture, router) = served();
    for path in [
        format!("/v1/objects/{}", fixture.extra),
        format!("/v1/objects/{}", Hash32::of(b"unknown")),
        "/v1/objects".to_owned(),
        "/v1/objects/".to_owned(),
        "/keys/targets.key".to_owned(),
    ] {
        get_with(&router, &path, &[]).await.problem(StatusCode::NOT_FOUND);
    }
    let upper = fixture.shards[2].0.to_string().to_uppercase();
    for name in [upper.as_str(), "..%2F..%2Fkeys%2Ftargets.key", "00", "%FF"] {
        get_with(&router, &format!("/v1/objects/{name}"), &[]).await.problem(StatusCode::BAD_REQUEST);
    }
    let (hash, _) = fixture.shards[2];
    fs_err::write(StoreReader::open(fixture.dir.path()).expect("published").object_path(hash), b"cut")
        .expect("writable");
    let answer = get_with(&router, &format!("/v1/objects/{hash}"), &[]).await;
    let detail = answer.problem(StatusCode::INTERNAL_SERVER_ERROR);
    assert!(!detail.contains("objects") && !detail.contains("bytes"), "no path in {detail}");
}

#[tokio::test]
async fn only_reading_without_bodies() {
    let (_fixture, router) = served();
    let post = Request::post("/v1/manifest").body(Body::empty()).expect("a request");
    let answer = ask(&router, post).await;
    answer.problem(StatusCode::METHOD_NOT_ALLOWED);
    assert_eq!(answer.header(header::ALLOW), "GET,HEAD");
    let long = Request::get("/v1/manifest").header("content-length", "1000000");
    let answer = ask(&router, long.body(Body::from(vec![0; 1_000_000])).expect("a request")).await;
    answer.problem(StatusCode::PAYLOAD_TOO_LARGE);
}

#[tokio::test]
async fn cells_near_a_point() {
    let fixture = fixture();
    let origin = Geographic { latitude_deg: 46.842657, longitude_deg: -91.994008, height_m: 158.5 };
    let reference = GeoReference { origin };
    let boxes: Vec<Aabb> = (0..60)
        .map(|i| {
            let (angle, i) = (f64::from(i) * 0.7, f64::from(i));
            let min = DVec3::new(i * angle.cos(), i * angle.sin(), i / 3.0);
            Aabb { min, max: min + DVec3::new(1.0, 2.0, i / 9.0) }
        })
        .collect();
    let unplaced = Manifest { generation: 3, ..manifest_of_boxes(&boxes) };
    fixture.store.publish(&unplaced, &Extras::new()).expect("publishes");
    let router = fixture.router_within(Limits::default()).expect("published");
    let at = "lat=46.8427&lon=-91.9940&radius=20";
    let detail = get_with(&router, &format!("/v1/cells?{at}"), &[]).await.problem(StatusCode::BAD_REQUEST);
    assert!(detail.contains("not geo-referenced"), "{detail}");
    let placed = Manifest { generation: 4, geo_reference: Some(reference), ..unplaced };
    fixture.store.publish(&placed, &Extras::new()).expect("publishes");

    let place = Geographic { latitude_deg: 46.8427, longitude_deg: -91.9940, ..origin };
    let centres = [
        ("x=3&y=-4.5&z=1e0&radius=20".to_owned(), DVec3::new(3.0, -4.5, 1.0)),
        (at.to_owned(), reference.world_from_geographic(place)),
        (
            format!("{at}&height=178.5"),
            reference.world_from_geographic(Geographic { height_m: 178.5, ..place }),
        ),
    ];
    for (query, centre) in centres {
        let answer = get_with(&router, &format!("/v1/cells?{query}"), &[]).await;
        assert_eq!(answer.status, StatusCode::OK, "{query}");
        let answer = answer.json();
        assert_eq!((&answer["generation"], &answer["encoder_id"]), (&4.into(), &"01".repeat(32).into()));
        // Oracle: brute force over the boxes, with distances by clamping.
        let distance = |b: &Aabb| centre.clamp(b.min, b.max).distance(centre);
        let near = boxes.iter().enumerate().filter(|(_, b)| distance(b) <= 20.0);
        let expected: Vec<(u64, f64)> = near.map(|(i, b)| (i as u64, distance(b))).collect();
        assert!(expected.len() > 5 && expected.len() < boxes.len(), "{query}: a test that says something");
        let cells = answer["cells"].as_array().expect("a list");
        assert_eq!(cells.len(), expected.len(), "{query}");
        for (cell, (cell_id, distance)) in cells.iter().zip(expected) {
            assert_eq!(cell["cell_id"], cell_id);
            assert!((cell["distance"].as_f64().expect("a number") - distance).abs() < 1e-12);
            assert_eq!(cell["n_gaussians"], cell_id + 1);
            let bounds: Aabb = serde_json::from_value(cell["bounds"].clone()).expect("a box");
            assert_eq!(bounds, boxes[cell_id as usize]);
            assert!(cell["shards"].is_object());
        }
    }
    let wrong = " radius=5 x=1&y=2&radius=5 x=1&y=2&z=3 x=1&y=2&z=3&radius=-1 x=1&y=2&z=3&radius=NaN \
        x=1&y=2&z=3&radius=inf x=nan&y=2&z=3&radius=1 x=1&y=2&z=3&radius=x x=1&y=2&z=3&radius=1&lat=1 \
        x=1&y=2&z=3&radius=1&height=1 x=1&x=1&y=2&z=3&radius=1 lat=91&lon=0&radius=1 lat=0&lon=181&radius=1 \
        lat=0&lon=0&height=inf&radius=1 lat=0&radius=1 x=1&y=2&z=3&radius=1&profile=exact";
    for query in wrong.split(' ') {
        let answer = get_with(&router, &format!("/v1/cells?{query}"), &[]).await;
        assert!(!answer.problem(StatusCode::BAD_REQUEST).is_empty(), "{query}");
    }
}

#[tokio::test]
async fn coverage_needs_a_place_on_the_earth() {
    let (fixture, router) = served();
    let answer = get_with(&router, "/v1/coverage.geojson", &[]).await;
    assert!(answer.problem(StatusCode::CONFLICT).contains("not geo-referenced"));
    let origin = Geographic { latitude_deg: 46.842657, longitude_deg: -91.994008, height_m: 158.5 };
    let geo_reference = Some(GeoReference { origin });
    let placed = Manifest { geo_reference, ..manifest(3, &fixture.listed(0..3)) };
    fixture.store.publish(&placed, &Extras::new()).expect("publishes");
    let answer = get_with(&router, "/v1/coverage.geojson", &[]).await;
    assert_eq!((answer.status.as_u16(), answer.header(header::CONTENT_TYPE)), (200, "application/geo+json"));
    let geojson: geojson::FeatureCollection = std::str::from_utf8(&answer.body).unwrap().parse().unwrap();
    assert_eq!(geojson.features.len(), 3);
}

#[tokio::test]
async fn new_manifest_is_noticed_and_a_damaged_one_is_not_served() {
    let (fixture, router) = served();
    let generation =
        async |router: &Router| get_with(router, "/healthz", &[]).await.json()["generation"].clone();
    assert_eq!(generation(&router).await, 2);
    fixture.store.publish(&manifest(3, &fixture.listed(2..3)), &Extras::new()).expect("publishes");
    assert_eq!(generation(&router).await, 3);
    let old = format!("/v1/objects/{}", fixture.shards[0].0);
    get_with(&router, &old, &[]).await.problem(StatusCode::NOT_FOUND);
    let before = get_with(&router, "/v1/manifest", &[]).await.body;

    let path = fixture.dir.path().join("manifest");
    let good = fs_err::read(&path).expect("readable");
    fs_err::write(&path, b"damaged").expect("writable");
    for _ in 0..5 {
        assert_eq!(generation(&router).await, 3);
    }
    assert_eq!(get_with(&router, "/v1/manifest", &[]).await.body, before);
    let counted = async |name: &str| {
        let metrics = get_with(&router, "/metrics", &[]).await.body;
        let lines = String::from_utf8_lossy(&metrics).into_owned();
        let value = lines.lines().find_map(|line| line.strip_prefix(name)?.trim().parse::<u64>().ok());
        value.unwrap_or_else(|| panic!("{name} is not in\n{lines}"))
    };
    assert_eq!(counted("slag_store_reload_failures_total ").await, 1, "reads of one damaged manifest");
    fs_err::write(&path, b"damaged otherwise").expect("writable");
    assert_eq!(generation(&router).await, 3);
    assert_eq!(counted("slag_store_reload_failures_total ").await, 2, "a changed file is read again");
    assert!(fixture.router_within(Limits::default()).is_err(), "but nothing starts from it");
    fs_err::write(&path, good).expect("writable");
    assert_eq!(generation(&router).await, 3);
    assert_eq!(counted("slag_store_reloads_total ").await, 2, "it is put in place when it opens again");
}

#[tokio::test]
async fn overload_and_timeout_are_problems() {
    let (entered, mut inside) = tokio::sync::mpsc::channel(1);
    let release = Arc::new(tokio::sync::Notify::new());
    let waiting = Arc::clone(&release);
    let wait = move || async move {
        entered.send(()).await.expect("the test listens");
        waiting.notified().await;
    };
    let routes = || Router::new().route("/quick", get(async || "done"));
    let limits = Limits { n_requests: 1, ..Limits::default() };
    let router =
        router::counted(routes().route("/wait", get(wait)), limits, Arc::default(), Access::default());
    let held = tokio::spawn(router.clone().oneshot(request("/wait", &[])));
    inside.recv().await.expect("the handler runs");
    let turned_away = get_with(&router, "/quick", &[]).await;
    turned_away.problem(StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(turned_away.header(header::RETRY_AFTER), "2");
    release.notify_one();
    held.await.expect("ends").expect("infallible");
    assert_eq!(get_with(&router, "/quick", &[]).await.status, StatusCode::OK);

    let limits = Limits { answer_timeout: Duration::from_millis(20), ..Limits::default() };
    let never = get(async || std::future::pending::<()>().await);
    let router = router::counted(routes().route("/never", never), limits, Arc::default(), Access::default());
    let late = get_with(&router, "/never", &[]).await;
    assert!(late.problem(StatusCode::SERVICE_UNAVAILABLE).contains("too long"));
    assert_eq!(late.header(header::RETRY_AFTER), "2");
}

/// A page alone has no list of resources, so nothing may name one.
#[tokio::test]
async fn a_page_alone_is_found_from_the_root() {
    let routes = Router::new().route("/view", get(async || "the page"));
    let router = bounded(routes, Limits::default(), Access::default());
    let root = get_with(&router, "/", &[]).await;
    assert_eq!((root.status.as_u16(), root.header(header::LOCATION)), (307, "/view"));
    let detail = get_with(&router, "/nowhere", &[]).await.problem(StatusCode::NOT_FOUND);
    let holds = detail.contains("\"/nowhere\"") && detail.contains("/view") && !detail.contains("GET /");
    assert!(holds, "{detail}");
    let fixture = fixture();
    let router = fixture.router_within(Limits::default()).expect("published");
    assert_eq!(get_with(&router, "/", &[]).await.status, StatusCode::OK);
    let detail = get_with(&router, "/nowhere", &[]).await.problem(StatusCode::NOT_FOUND);
    assert!(detail.contains("GET / lists the resources"), "{detail}");
}

#[tokio::test]
async fn downloads_are_counted_until_they_end() {
    let fixture = fixture();
    let limits = Limits { n_downloads: 1, ..Limits::default() };
    let router = fixture.router_within(limits).expect("published");
    let path = format!("/v1/objects/{}", fixture.shards[1].0);
    let unread = router.clone().oneshot(request(&path, &[])).await.expect("infallible");
    assert_eq!(unread.status(), StatusCode::OK);
    get_with(&router, &path, &[]).await.problem(StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(get_with(&router, "/v1/manifest", &[]).await.status, StatusCode::OK);
    drop(unread);
    assert_eq!(get_with(&router, &path, &[]).await.status, StatusCode::OK);
}

#[tokio::test]
async fn every_described_resource_and_parameter_is_answered() {
    let (fixture, router) = served();
    let (_, table) = router::described();
    assert!(table.len() >= 7, "{table:?}");
    for route in &table {
        let path = match route.path {
            "/v1/metadata/{name}" => "/v1/metadata/timestamp.json".to_owned(),
            "/v1/targets/{name}" => format!("/v1/targets/{}.manifest", fixture.manifest_sha256()),
            path => path.replace("{hash}", &fixture.shards[1].0.to_string()),
        };
        assert_ne!(get_with(&router, &path, &[]).await.status, StatusCode::NOT_FOUND, "{path}");
    }
    let unknown =
        get_with(&router, "/v1/cells?radius=1&profile=1", &[]).await.problem(StatusCode::BAD_REQUEST);
    assert!(unknown.contains("one of x, y, z, lat, lon, height, radius"), "{unknown}");
}
