use axum::routing::get;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use super::*;

const REQUEST: &str = "GET /quick HTTP/1.1\r\nHost: x\r\n\r\n";
/// More than the sockets' buffers hold.
const LONG_BYTES: usize = 40_000_000;

/// A running service: its address, its stop, and its end.
struct Running {
    address: SocketAddr,
    stop: oneshot::Sender<()>,
    ended: JoinHandle<Result<(), CutOff>>,
}

async fn start(limits: ConnectionLimits) -> Running {
    let router = Router::new()
        .route("/quick", get(async || "done"))
        .route("/long", get(async || vec![7u8; LONG_BYTES]));
    let (stop, stopped) = oneshot::channel();
    let listener = bind("127.0.0.1:0".parse().expect("an address")).await.expect("a port");
    let address = listener.local_addr().expect("bound");
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

#[tokio::test]
async fn connections_beyond_the_limit_wait() {
    let running = start(ConnectionLimits { n_connections: 1, ..ConnectionLimits::default() }).await;
    let mut first = connect(running.address, REQUEST).await;
    first.read_exact(&mut [0; 12]).await.expect("answered");
    let mut second = connect(running.address, REQUEST).await;
    let mut received = [0; 12];
    let early = tokio::time::timeout(Duration::from_millis(100), second.read_exact(&mut received)).await;
    assert!(early.is_err(), "not while the first is open");
    drop(first);
    second.read_exact(&mut received).await.expect("answered then");
    assert_eq!(&received, b"HTTP/1.1 200");
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
    let mut stream =
        connect(running.address, &format!("GET /quick HTTP/1.1\r\nHost: x\r\nCookie: {cookie}\r\n\r\n"))
            .await;
    let mut received = Vec::new();
    let _ = stream.read_to_end(&mut received).await;
    assert!(received.starts_with(b"HTTP/1.1 431"), "{}", String::from_utf8_lossy(&received));
}

/// A client that does not read holds up the stop until the deadline, one that does not ask not at all.
#[tokio::test]
async fn stopping_has_a_deadline() {
    let drain_timeout = Duration::from_millis(60);
    let limits = ConnectionLimits { drain_timeout, ..ConnectionLimits::default() };
    let running = start(limits).await;
    let mut unread = connect(running.address, &REQUEST.replace("quick", "long")).await;
    unread.read_exact(&mut [0; 10]).await.expect("begins");
    running.stop.send(()).expect("runs");
    assert_eq!(running.ended.await.expect("ends"), Err(CutOff { after: drain_timeout }));

    let running = start(ConnectionLimits::default()).await;
    let mut idle = connect(running.address, REQUEST).await;
    idle.read_exact(&mut [0; 12]).await.expect("answered");
    running.stop.send(()).expect("runs");
    assert_eq!(running.ended.await.expect("ends"), Ok(()));
    assert!(TcpStream::connect(running.address).await.is_err(), "no longer listening");
}

#[tokio::test]
async fn an_occupied_address_is_an_error_that_names_it() {
    let running = start(ConnectionLimits::default()).await;
    let refused = bind(running.address).await.expect_err("taken").to_string();
    assert!(
        refused.contains(&running.address.to_string()) && refused.contains("another address"),
        "{refused}"
    );
}
