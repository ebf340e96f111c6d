use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};

use super::*;
use slag_test_support::assert_error;

fn in_memory() -> Bucket {
    let runtime = Arc::new(Builder::new_multi_thread().worker_threads(N_THREADS).build().expect("starts"));
    let store: Arc<dyn ObjectStore> = Arc::new(object_store::memory::InMemory::new());
    Bucket { store, prefix: Key::from("scene"), url: "memory://scene".into(), is_local: false, runtime }
}

/// Conformance of every kind of bucket; `other` is the same one, opened again. S3: `tests/fleet/s3.rs`, real servers.
fn conforms(one: &Bucket, other: &Bucket) {
    assert!(one.put_new("jobs/2/plan.json", "first").expect("puts"));
    assert!(!other.put_new("jobs/2/plan.json", "second").expect("puts"), "a conditional put is one for all");
    one.put("jobs/1/end.json", "0123").expect("puts");
    one.put("jobs/1/end.json", "0123456789").expect("puts");
    assert_eq!(other.get("jobs/2/plan.json").expect("reads").as_deref(), Some(&b"first"[..]));
    assert_eq!(other.list("jobs").expect("lists"), ["1/end.json", "2/plan.json"]);
    assert!(other.list("none").expect("lists").is_empty() && other.get("none").expect("reads").is_none());
    assert_eq!(other.len_of("jobs/1/end.json").expect("asks"), Some(10));
    assert_eq!(other.len_of("jobs/3").expect("asks"), None);
    assert_error(other.require("jobs/3"), &["jobs/3 is missing"]);
    // An existing object is one's own if it has the same bytes.
    assert!(one.claim("end", "mine").expect("claims") && one.claim("end", "mine").expect("claims"));
    assert!(!other.claim("end", "another's").expect("claims"));
}

#[test]
fn folders_and_object_stores_are_alike() {
    let dir = tempfile::tempdir().expect("a folder");
    let open = || Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens");
    conforms(&open(), &open());
    let memory = in_memory();
    conforms(&memory, &memory.clone());
    assert_error(Bucket::open("ftp://somewhere/else", []), &["ftp://somewhere/else"]);
}

/// Reads a request up to the end of its head, or of the body `mine`; returns its method.
fn read_request(stream: &mut TcpStream) -> String {
    let is_whole = |request: &[u8]| {
        request.ends_with(b"mine") || request.starts_with(b"GET") && request.ends_with(b"\r\n\r\n")
    };
    let mut request = Vec::new();
    while !is_whole(&request) {
        let mut byte = [0];
        stream.read_exact(&mut byte).expect("a request");
        request.extend(byte);
    }
    String::from_utf8_lossy(&request).split(' ').take(1).collect()
}

/// A server takes an object and resets the connection; the put is made again, and finds the object in place.
#[test]
fn a_put_whose_answer_is_lost_is_made_again() {
    let server = TcpListener::bind("127.0.0.1:0").expect("a port");
    let endpoint = format!("http://{}", server.local_addr().expect("an address"));
    let serve = move || {
        let (mut first, _) = server.accept().expect("a request");
        // Unread bytes at closing reset the connection.
        let mut whole = [0; 4096];
        while !first.peek(&mut whole).is_ok_and(|n| whole[..n].ends_with(b"mine")) {}
        first.read_exact(&mut [0]).expect("a request");
        drop(first);
        ["412 Precondition Failed", "200 OK"].map(|status| {
            let (mut stream, _) = server.accept().expect("a request");
            let method = read_request(&mut stream);
            let body = if method == "GET" { "mine" } else { "" };
            let len = body.len();
            let head = format!("HTTP/1.1 {status}\r\nContent-Length: {len}\r\nConnection: close\r\n");
            let about = "Last-Modified: Thu, 26 Nov 2026 12:00:00 GMT\r\nETag: \"1\"\r\n";
            write!(stream, "{head}{about}\r\n{body}").expect("an answer");
            method
        })
    };
    let served = std::thread::spawn(serve);
    let variables = [
        ("AWS_ENDPOINT", endpoint.as_str()),
        ("AWS_ALLOW_HTTP", "true"),
        ("AWS_ACCESS_KEY_ID", "robot"),
        ("AWS_SECRET_ACCESS_KEY", "secret"),
        ("AWS_REGION", "here"),
    ];
    let variables = variables.map(|(name, value)| (name.to_owned(), value.to_owned()));
    let bucket = Bucket::open("s3://scenes/room", variables).expect("opens");
    assert!(bucket.claim("jobs/1/end.json", "mine").expect("claims"));
    assert_eq!(served.join().expect("served"), ["PUT", "GET"]);
}
