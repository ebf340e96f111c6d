use std::net::SocketAddr;

use axum::body::Bytes;
use axum::routing::get;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use super::*;
use crate::access::Access;
use crate::listen::{Listen, bind};
use crate::openapi::About;
use crate::problem::NoMembers;
use crate::replies::As;
use crate::request::observed;
use crate::routes::Routes;

const REQUEST: &str = "GET /quick HTTP/1.1\r\nHost: localhost\r\n\r\n";
/// More than the sockets' buffers hold.
const LONG_BYTES: usize = 40_000_000;

struct Running {
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    ended: JoinHandle<io::Result<()>>,
}

async fn start(limits: ConnectionLimits) -> Running {
    let routes = Routes::default()
        .get("/quick", "an answer", async || "done")
        .get("/slow", "an answer that takes a while", async || {
            tokio::time::sleep(Duration::from_millis(50)).await;
            "done"
        })
        .get("/healthz", "whether it lives", async || "alive")
        .post::<u8, _, _>("/things", "takes a thing", 64, async |body: Bytes| As::<&'static str>::new(body));
    let about = About { name: "test", version: "1", license: "MIT", summary: "", errors: &[] };
    let router = routes.described::<NoMembers>(about).0.route("/long", get(async || vec![7u8; LONG_BYTES]));
    let router = observed(router, std::sync::Arc::default(), Access::default());
    let (stop, stopped) = oneshot::channel();
    let any_port: SocketAddr = "127.0.0.1:0".parse().expect("an address");
    let listener = bind(&any_port.into()).await.expect("a port");
    let url = listener.url().expect("bound");
    let address = url.strip_prefix("http://").and_then(|address| address.parse().ok()).expect("an address");
    let ended = tokio::spawn(serve(router, listener, limits, async move {
        let _ = stopped.await;
    }));
    Running { address, stop, ended }
}

async fn connect(address: SocketAddr, text: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.expect("listens");
    stream.write_all(text.as_bytes()).await.expect("sends");
    stream
}

const HALF_A_BODY: &str = "POST /things HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{\"x\"";

/// Sends a request and returns all bytes received until the other end closes.
async fn ask_once(address: SocketAddr, text: &str) -> String {
    let mut stream = connect(address, text).await;
    let mut received = Vec::new();
    let whole = tokio::time::timeout(Duration::from_secs(5), stream.read_to_end(&mut received)).await;
    drop(whole.expect("ends"));
    String::from_utf8_lossy(&received).into_owned()
}

/// The attack: sockets with half a body take every place.
#[tokio::test]
async fn half_bodies_leave_room_for_health_and_end() {
    let body_timeout = Duration::from_millis(1500);
    let limits =
        ConnectionLimits { n_connections: 8, n_reserved: 4, body_timeout, ..ConnectionLimits::default() };
    let running = start(limits).await;
    let mut half = Vec::new();
    for _ in 0..20 {
        half.push(connect(running.address, HALF_A_BODY).await);
    }
    let started = tokio::time::Instant::now();
    let health = ask_once(running.address, "GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n").await;
    assert!(health.starts_with("HTTP/1.1 200") && health.ends_with("alive"), "{health}");
    let refused = ask_once(running.address, REQUEST).await.to_lowercase();
    assert!(refused.starts_with("http/1.1 503") && refused.contains("retry-after: "), "{refused}");
    assert!(started.elapsed() < body_timeout, "while all are half");
    let mut slow = Vec::new();
    half[0].read_to_end(&mut slow).await.expect("ends");
    let slow = String::from_utf8_lossy(&slow);
    assert!(slow.starts_with("HTTP/1.1 408") && slow.contains("urn:slag:problem:body-timeout"), "{slow}");
    drop(half);
    let again = REQUEST.replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
    assert!(ask_once(running.address, &again).await.ends_with("done"));
}

/// As `nc -N` does: nothing more is asked, and the answer is waited for.
#[tokio::test]
async fn a_client_that_has_asked_all_gets_its_answer() {
    let running = start(ConnectionLimits::default()).await;
    let mut stream = connect(running.address, &REQUEST.replace("/quick", "/slow")).await;
    stream.shutdown().await.expect("half closes");
    let mut received = String::new();
    stream.read_to_string(&mut received).await.expect("ends");
    assert!(received.starts_with("HTTP/1.1 200") && received.ends_with("done"), "{received}");
}

#[tokio::test]
async fn bodies_are_whole_json_and_short() {
    let running = start(ConnectionLimits::default()).await;
    let whole = HALF_A_BODY.replace("{\"x\"", "{\"x\":1.5}").replace(": 9", ": 9\r\nConnection: close");
    assert!(ask_once(running.address, &whole).await.ends_with("{\"x\":1.5}"));
    let identity = whole.replace("Content-Type", "Content-Encoding: identity\r\nContent-Type");
    assert!(ask_once(running.address, &identity).await.ends_with("{\"x\":1.5}"));
    let gzip = whole.replace("Content-Type", "Content-Encoding: GZIP\r\nContent-Type");
    let answer = ask_once(running.address, &gzip).await.to_lowercase();
    assert!(answer.starts_with("http/1.1 415") && answer.contains("accept-encoding: identity"), "{answer}");
    assert!(answer.contains("content-encoding is \\\"gzip\\\", expected none"), "{answer}");
    for (from, to, status) in [
        ("application/json", "text/plain", 415),
        ("Content-Type: application/json\r\n", "", 415),
        ("Content-Length: 9", "Content-Length: 65", 413),
        ("Content-Length: 9", "Transfer-Encoding: chunked", 400),
    ] {
        let answer = ask_once(running.address, &whole.replace(from, to)).await;
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{to}: {answer}");
    }
}

/// A client that sends its whole body before reading, as Python's does, learns why the body was refused.
#[tokio::test]
async fn refused_bodies_are_drained() {
    let running = start(ConnectionLimits::default()).await;
    let pieces = [[b' '; 100_000]; 4];
    for (path, kind, status) in
        [("things", "application/json", 413), ("things", "text/plain", 415), ("nowhere", "text/plain", 404)]
    {
        let head = format!(
            "POST /{path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Type: {kind}\r\n\
             Content-Length: 400000\r\n\r\n"
        );
        let mut stream = connect(running.address, &head).await;
        for piece in &pieces {
            // Long enough for sending the answer and closing the connection.
            tokio::time::sleep(Duration::from_millis(60)).await;
            stream.write_all(piece).await.unwrap_or_else(|e| panic!("{status}: {e}"));
        }
        let mut answer = String::new();
        let whole = stream.read_to_string(&mut answer);
        tokio::time::timeout(Duration::from_secs(5), whole).await.expect("ends").expect("an answer");
        assert!(answer.starts_with(&format!("HTTP/1.1 {status}")), "{answer}");
    }
    // The attack: an endless body is dropped after a second.
    let head = "POST /nowhere HTTP/1.1\r\nHost: localhost\r\nContent-Length: 400000\r\n\r\n";
    let started = tokio::time::Instant::now();
    assert!(ask_once(running.address, head).await.starts_with("HTTP/1.1 404"));
    assert!(started.elapsed() < Duration::from_secs(4), "{:?}", started.elapsed());
}

#[tokio::test]
async fn unix_sockets_are_served() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("s");
    let listener = bind(&Listen::Unix(path.clone())).await.expect("binds");
    let router = Router::new().route("/quick", get(async || "done"));
    let limits = ConnectionLimits { n_per_peer: 0, ..ConnectionLimits::default() };
    let (stop, stopped) = oneshot::channel::<()>();
    let served = tokio::spawn(serve(router, listener, limits, async move { drop(stopped.await) }));
    let mut stream = tokio::net::UnixStream::connect(&path).await.expect("listens");
    let request = REQUEST.replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.expect("sends");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.expect("answers");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("done"), "{answer}");
    stop.send(()).expect("runs");
    served.await.expect("ends").expect("in time");
    assert!(!path.exists());
}

/// Either deadline ends half a request and an idle connection.
#[tokio::test]
async fn stalled_connections_are_dropped() {
    let quick = Duration::from_millis(60);
    let limits = ConnectionLimits::default();
    for limits in [
        ConnectionLimits { stall_timeout: quick, ..limits },
        ConnectionLimits { head_timeout: quick, ..limits },
    ] {
        let running = start(limits).await;
        let mut half = connect(running.address, "GET /quick HTTP/1.1\r\nHost:").await;
        let mut idle = connect(running.address, REQUEST).await;
        let mut received = Vec::new();
        let _ = half.read_to_end(&mut received).await;
        assert!(!String::from_utf8_lossy(&received).contains(" 200 "), "{received:?}");
        received.clear();
        let _ = idle.read_to_end(&mut received).await;
        assert!(received.starts_with(b"HTTP/1.1 200 "));
    }
}

#[tokio::test]
async fn long_heads_are_refused() {
    let running = start(ConnectionLimits::default()).await;
    let cookie = "x".repeat(30_000);
    let mut stream = connect(
        running.address,
        &format!("GET /quick HTTP/1.1\r\nHost: localhost\r\nCookie: {cookie}\r\n\r\n"),
    )
    .await;
    let mut received = Vec::new();
    let _ = stream.read_to_end(&mut received).await;
    assert!(received.starts_with(b"HTTP/1.1 431"), "{}", String::from_utf8_lossy(&received));
}

/// A stop waits for a slow reader until the deadline, and not for an idle client. A download in progress ends whole.
#[tokio::test]
async fn stopping_has_a_deadline() {
    let drain_timeout = Duration::from_millis(60);
    let limits = ConnectionLimits { drain_timeout, ..ConnectionLimits::default() };
    let running = start(limits).await;
    let mut unread = connect(running.address, &REQUEST.replace("quick", "long")).await;
    unread.read_exact(&mut [0; 10]).await.expect("begins");
    running.stop.send(()).expect("runs");
    assert_eq!(running.ended.await.expect("ends").expect_err("cut off").kind(), io::ErrorKind::TimedOut);

    let running = start(ConnectionLimits::default()).await;
    let mut idle = connect(running.address, REQUEST).await;
    idle.read_exact(&mut [0; 12]).await.expect("answered");
    let mut slow = connect(running.address, &REQUEST.replace("quick", "long")).await;
    slow.read_exact(&mut [0; 10]).await.expect("begins");
    running.stop.send(()).expect("runs");
    let mut rest = Vec::new();
    slow.read_to_end(&mut rest).await.expect("ends whole");
    assert!(rest.len() > LONG_BYTES && rest[rest.len() - LONG_BYTES..].iter().all(|byte| *byte == 7));
    running.ended.await.expect("ends").expect("in time");
    assert!(TcpStream::connect(running.address).await.is_err(), "no longer listening");
}

#[tokio::test]
async fn an_occupied_address_is_an_error_that_names_it() {
    let running = start(ConnectionLimits::default()).await;
    let refused = bind(&running.address.into()).await.expect_err("taken").to_string();
    let holds = refused.contains(&running.address.to_string()) && refused.contains("another address");
    assert!(holds, "{refused}");
}

#[test]
fn times_that_no_date_can_name() {
    let at = |secs: u64| UNIX_EPOCH + Duration::from_secs(secs);
    let dates =
        [at(0), at(YEAR_10000_UNIX_SECS - 1), at(YEAR_10000_UNIX_SECS), UNIX_EPOCH - Duration::from_secs(1)];
    assert_eq!(dates.map(is_of_a_date), [true, true, false, false]);
}
