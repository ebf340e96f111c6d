//! Attacks on the service, and their defences.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use slag_common::retry::Backoff;
use slag_service::access::{Access, AccessSettings};

use super::*;
use crate::fetch::follow::{FollowEnvironment, FollowSettings, follow};
use crate::fetch::{FetchError, FetchRequest};

/// Sends a request with headers to a service that follows a robot; returns the status and the problem's type.
async fn ask(app: &Arc<App>, method: &str, uri: &str, headers: &[(&str, &str)]) -> (u16, Value) {
    let mut request = Request::builder().method(method).uri(uri).header("host", "127.0.0.1:7734");
    for (name, value) in headers {
        if *name == "host" {
            request.headers_mut().expect("sound").remove("host");
        }
        request = request.header(*name, *value);
    }
    let body = if method == "POST" { Body::from(r#"{"x":1,"y":2,"z":3}"#) } else { Body::empty() };
    let request = request.body(body).expect("a request");
    let (status, _, body) = read(router(Arc::clone(app)).oneshot(request).await.expect("infallible")).await;
    (status.as_u16(), body["type"].clone())
}

fn following_app(service: &Service, access: Access) -> (Arc<App>, Arc<Following>) {
    let following = Arc::<Following>::default();
    let (text, _) = axes_service(3, Gate::default());
    let engine = Engine::new(EdgeCache::open(service.dir.path()), text);
    engine.reload().expect("a scene");
    let settings = Settings { access, ..Settings::default() };
    (App::following(engine, settings, Some(Arc::clone(&following))), following)
}

/// A web page posts to the robot, or reads it through a name that resolves to it (DNS rebinding).
#[tokio::test]
async fn web_pages_neither_write_nor_read() {
    let service = Service::with_chair();
    let (app, following) = following_app(&service, Access::default());
    let json = ("content-type", "application/json");
    let form = ("content-type", "application/x-www-form-urlencoded");
    let utf16 = ("content-type", "application/json; Charset=\"utf-16\"");
    let evil = ("origin", "https://evil.example");
    let no_cors = [("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors")];
    let problem = |kind: &str| Value::String(format!("urn:slag:problem:{kind}"));
    for (method, uri, headers, status, kind) in [
        ("POST", "/position", &[("content-type", "text/plain")][..], 415, "unsupported-media-type"),
        ("POST", "/position", &[form], 415, "unsupported-media-type"),
        ("POST", "/position", &[], 415, "unsupported-media-type"),
        ("POST", "/position", &[utf16], 415, "unsupported-media-type"),
        ("POST", "/position", &[json, evil], 403, "foreign-origin"),
        ("POST", "/position", &[json, ("origin", "null")], 403, "foreign-origin"),
        ("POST", "/position", &[json, ("host", "evil.example")], 421, "wrong-host"),
        ("GET", "/status", &[("host", "evil.example:7734")], 421, "wrong-host"),
        ("GET", "/query?text=0", &no_cors, 403, "foreign-origin"),
        ("OPTIONS", "/position", &[evil, ("access-control-request-method", "POST")], 403, "foreign-origin"),
    ] {
        let answer = ask(&app, method, uri, headers).await;
        assert_eq!(answer, (status, problem(kind)), "{method} {uri} {headers:?}");
    }
    assert_eq!(following.status().position, None, "nothing moved the robot");
    assert_eq!(ask(&app, "POST", "/position", &[json]).await.0, 202);
    assert_eq!(ask(&app, "POST", "/position", &[json, ("origin", "http://127.0.0.1:7734")]).await.0, 202);
}

/// A question in JSON only reads: it is admitted as GET is, with and without a token.
#[tokio::test]
async fn questions_in_json_are_reads() {
    let service = Service::with_chair();
    let file = service.dir.path().join("token");
    fs_err::write(&file, "0123456789abcdef0123").expect("written");
    let with_token = AccessSettings { token_file: Some(file), ..AccessSettings::default() };
    let json = [("content-type", "application/json")];
    for (listen, settings, refused) in
        [("127.0.0.1:7734", with_token, 401), ("0.0.0.0:7734", AccessSettings::default(), 403)]
    {
        let access = Access::new(&listen.parse().expect("an address"), settings).expect("sound");
        let (app, _) = following_app(&service, access);
        assert_eq!(ask(&app, "POST", "/position", &json).await.0, refused, "{listen}");
        // The body is a position: it is read, but is no valid query.
        assert_eq!(ask(&app, "POST", "/v1/query", &json).await.0, 400, "{listen}");
        let foreign = [json[0], ("origin", "https://evil.example")];
        assert_eq!(ask(&app, "POST", "/v1/query", &foreign).await.0, 403, "{listen}");
    }
}

/// Every described route is bounded in size and time by the cells on board, or charges its budget.
#[tokio::test]
async fn every_route_keeps_within_its_budget() {
    let room = super::v1::room_with(Some(&super::goal::places()));
    let bounded = "GET /, GET /healthz, GET /metrics, GET /openapi.json, GET /readyz, GET /status, GET /v1/events, \
                   GET /v1/map, POST /position";
    let bounded: Vec<&str> = bounded.split(", ").collect();
    let questions = [
        r#"{"texts": ["0"], "kind": "clusters"}"#,
        r#"{"texts": ["0"], "kind": "gaussians"}"#,
        r#"{"texts": ["0 near the 1"]}"#,
        r#"{"vectors": [[1, 0, 0]]}"#,
        r#"{"phrases": [{"thing": "0", "relation": {"is": "near", "of": {"thing": "1"}}}]}"#,
    ];
    let mut asked: Vec<(String, &str, Vec<u8>)> = Vec::new();
    for (path, methods) in super::openapi::description()["paths"].as_object().expect("paths") {
        for method in methods.as_object().expect("methods").keys() {
            let route = format!("{} {path}", method.to_uppercase());
            if bounded.contains(&route.as_str()) {
                continue;
            }
            let uri = match route.as_str() {
                "GET /query" => "/query?text=0&format=ply",
                "GET /v1/query" => "/v1/query?text=0",
                "GET /v1/objects/{id}" => "/v1/objects/o0000000000000001",
                "GET /v1/objects/{id}/thumbnail" => "/v1/objects/o0000000000000001/thumbnail",
                "GET /v1/goal" => "/v1/goal?text=0&near=2,3,0&step_m=0.15",
                "GET /v1/floor" => "/v1/floor?near=2,3,0&step_m=0.15",
                "GET /v1/view/scores" => "/v1/view/scores?text=0",
                "GET /v1/view/cells/{id}" => "/v1/view/cells/1",
                "GET /v1/objects" | "GET /v1/changes" | "GET /v1/view" | "GET /v1/view/words" => path,
                "POST /v1/query" => {
                    let json = "application/json";
                    asked.extend(questions.map(|body| (path.clone(), json, body.as_bytes().to_vec())));
                    continue;
                }
                "POST /v1/locate" => {
                    let uri = format!("{path}?focal_px=500");
                    asked.push((uri, "image/png", super::locate::png(640, 480)));
                    continue;
                }
                other => panic!("{other} is new: does it charge what it allocates, and look at the clock?"),
            };
            asked.push((uri.to_owned(), "", Vec::new()));
        }
    }
    let unlimited = Settings::default();
    for (settings, spent) in [
        (Settings { query_bytes: 1, ..unlimited.clone() }, "1 bytes of memory"),
        (Settings { query_timeout: Duration::ZERO, ..unlimited }, "more than 0 s"),
    ] {
        let service = Service::new(Some(&room), settings);
        for (uri, kind, body) in &asked {
            let (status, _, answer) = match kind.is_empty() {
                true => service.get(uri).await,
                false => service.post(uri, kind, body.clone()).await,
            };
            let kind = answer["type"].as_str().unwrap_or_default();
            let context = format!("{spent}: {uri} {}: {answer}", String::from_utf8_lossy(body));
            let says_so = answer["detail"].as_str().is_some_and(|detail| detail.contains(spent));
            // On a busy machine the outer timeout comes first.
            let is_late =
                spent.ends_with(" s") && (status.as_u16(), kind) == (503, "urn:slag:problem:timeout");
            let is_spent = (status.as_u16(), kind) == (422, "urn:slag:problem:over-budget") && says_so;
            assert!(is_spent || is_late, "{context}");
        }
    }
}

#[tokio::test]
async fn an_origin_that_was_given_may_ask_and_read() {
    let service = Service::with_chair();
    let listen = "127.0.0.1:7734".parse().expect("an address");
    let settings =
        AccessSettings { origins: vec!["https://map.example".into()], ..AccessSettings::default() };
    let (app, _) = following_app(&service, Access::new(&listen, settings).expect("sound"));
    for (method, uri, status) in
        [("OPTIONS", "/position", 204), ("GET", "/query?text=0", 200), ("GET", "/query", 400)]
    {
        let request = Request::builder().method(method).uri(uri).header("host", "127.0.0.1:7734");
        let request =
            request.header("origin", "https://map.example").header("access-control-request-method", "POST");
        let request = request.header("x-request-id", "map-17").body(Body::empty()).expect("a request");
        let response = router(Arc::clone(&app)).oneshot(request).await.expect("infallible");
        assert_eq!(response.status().as_u16(), status, "{method} {uri}");
        let header = |name: &str| response.headers().get(name).and_then(|value| value.to_str().ok());
        assert_eq!(header("access-control-allow-origin"), Some("https://map.example"));
        assert_eq!((header("vary"), header("x-request-id")), (Some("origin"), Some("map-17")));
        assert_eq!(header("access-control-allow-methods").is_some(), status == 204);
    }
    let (_, headers, _) = service.get("/query?text=0").await;
    assert!(!headers.contains_key("access-control-allow-origin"));
}

/// After a panic of the follower, nothing claims that the robot is followed until it is again.
#[tokio::test]
async fn a_follower_that_panics_is_reported_and_begins_again() {
    let service = Service::with_chair();
    let (app, following) = following_app(&service, Access::default());
    let json = [("content-type", "application/json")];
    assert_eq!(ask(&app, "GET", "/readyz", &[]).await.0, 200);
    let (n_runs, cancel, heal) = (AtomicU64::new(0), AtomicBool::new(false), AtomicBool::new(false));
    let restarts = Backoff { first: Duration::from_millis(20), longest: Duration::from_millis(80) };
    let run = || {
        n_runs.fetch_add(1, Ordering::SeqCst);
        assert!(heal.load(Ordering::SeqCst), "the disk of {}", "a test");
        "followed"
    };
    let failed = std::thread::scope(|threads| {
        let kept = threads.spawn(|| keep_following(&following, restarts, &cancel, &run));
        let give_up = std::time::Instant::now() + Duration::from_secs(10);
        while n_runs.load(Ordering::SeqCst) < 3 && std::time::Instant::now() < give_up {
            std::thread::sleep(Duration::from_millis(2));
        }
        let failed = following.failure();
        heal.store(true, Ordering::SeqCst);
        assert_eq!(kept.join().expect("no panic"), Some("followed"));
        failed
    });
    assert!(failed.is_some_and(|text| text.contains("the disk of a test")));
    assert!(n_runs.load(Ordering::SeqCst) >= 4 && following.status().n_restarts >= 3);

    // It runs again, but no fetch has ended yet.
    let down = Value::String("urn:slag:problem:follower-failed".into());
    assert_eq!(ask(&app, "GET", "/readyz", &[]).await, (503, down.clone()));
    assert_eq!(ask(&app, "POST", "/position", &json).await, (503, down));
    let found = following.status().position;
    assert_eq!(found, Some(Position::World(DVec3::new(1.0, 2.0, 3.0))), "kept all the same");
    let metrics = read(service_of(&app, "/metrics").await).await.2;
    let metrics = metrics.as_str().expect("text");
    let restarts = following.status().n_restarts;
    assert!(metrics.contains("slag_edge_follower_up 0\n"), "{metrics}");
    assert!(metrics.contains(&format!("slag_edge_follower_restarts_total {restarts}\n")), "{metrics}");

    let cancelled = AtomicBool::new(true);
    assert_eq!(keep_following(&following, RESTARTS, &cancelled, || -> () { panic!("again") }), None);
    let environment = FollowEnvironment {
        fetch: &mut |_| Err(FetchError::Cancelled),
        report: &mut |_| (),
        random: &|| 0.5,
        cancel: &AtomicBool::new(false),
    };
    let cache = EdgeCache::open(service.dir.path());
    let followed =
        follow(&cache, &FetchRequest::default(), FollowSettings::default(), &following, environment);
    assert!(matches!(followed, Err(FetchError::Cancelled)), "a fetch has ended");
    assert_eq!(ask(&app, "GET", "/readyz", &[]).await.0, 200);
    assert_eq!(ask(&app, "POST", "/position", &json).await.0, 202);
}

async fn service_of(app: &Arc<App>, uri: &str) -> Response {
    let request = Request::get(uri).body(Body::empty()).expect("a request");
    router(Arc::clone(app)).oneshot(request).await.expect("infallible")
}
