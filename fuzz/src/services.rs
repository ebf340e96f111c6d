//! Targets that need more than a function: the robot's service, and a TUF repository.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::OnceLock;
use std::time::Duration;

use slag_common::tuf::{Kept, Source, add_signatures, refresh};
use slag_edge::http::{self, App, Settings};
use slag_edge::query::Engine;
use slag_edge::store::EdgeCache;
use slag_edge::text::{EncoderInfo, TextService};
use slag_models::{InferenceError, TextEncoder};
use slag_service::listen::{Listen, bind};

use super::repository::{REPLACED, key, repository};
use super::seeds;

/// Requests little and closes the connection; earlier bytes may be incomplete.
const LAST: &[u8] = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
const MAX_ANSWER_BYTES: u64 = 1 << 20;

/// An encoder that knows any text beginning with a letter.
struct Letters;

impl TextEncoder for Letters {
    fn dim(&self) -> usize {
        3
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        let first = text.bytes().next().filter(u8::is_ascii_alphabetic).ok_or(InferenceError::EmptyText)?;
        Ok((0..3).map(|axis| f32::from(axis == first % 3)).collect())
    }
}

/// Starts the robot's service with a small scene once; returns its socket.
fn service() -> &'static PathBuf {
    static SOCKET: OnceLock<PathBuf> = OnceLock::new();
    SOCKET.get_or_init(|| {
        let folder = std::env::temp_dir().join(format!("slag-fuzz-{}", std::process::id()));
        fs_err::create_dir_all(&folder).expect("a folder");
        let info =
            EncoderInfo { name: "letters".into(), id: seeds::ENCODER, dim: 3, execution_provider: "none" };
        let text = TextService::start(info, Box::new(Letters)).expect("a thread");
        seeds::write_scene(&folder.join("cache"));
        let engine = Engine::new(EdgeCache::open(folder.join("cache")), text);
        engine.reload().expect("a scene");
        let app = App::new(engine, Settings::default());
        let socket = folder.join("socket");
        let listen = Listen::Unix(socket.clone());
        let (ready, is_ready) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
            runtime.expect("a runtime").block_on(async {
                let listener = bind(&listen).await.expect("binds");
                ready.send(()).expect("waited for");
                http::serve(app, listener, std::future::pending()).await
            })
        });
        is_ready.recv().expect("listens");
        socket
    })
}

pub fn v1(data: &[u8]) -> bool {
    let head = format!(
        "POST /v1/query HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n",
        data.len()
    );
    http_request(&[head.as_bytes(), data].concat())
}

/// Bytes of a connection to the robot's service: no handler may panic, and the service must keep answering.
pub fn http_request(data: &[u8]) -> bool {
    let mut stream = UnixStream::connect(service()).expect("the service listens");
    // An incomplete request gets no answer for seconds.
    stream.set_read_timeout(Some(Duration::from_millis(20))).expect("set");
    // The service may have closed the connection already.
    let _ = stream.write_all(data).and_then(|()| stream.write_all(LAST));
    let mut answer = Vec::new();
    let _ = stream.take(MAX_ANSWER_BYTES).read_to_end(&mut answer);
    let answer = String::from_utf8_lossy(&answer);
    assert!(!answer.contains("HTTP/1.1 500"), "{answer}");
    answer.starts_with("HTTP/1.1 2")
}

struct Files(BTreeMap<String, Vec<u8>>);

impl Source for Files {
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String> {
        Ok(self.0.get(name).map(|bytes| bytes.iter().copied().take(max_bytes as usize + 1).collect()))
    }
}

/// One role's metadata in a valid repository, signed with its key as far as possible.
pub fn tuf(data: &[u8]) -> bool {
    let Some((role, signed)) = data.split_first() else { return false };
    let envelope = [b"{\"signatures\":[],\"signed\":", signed, b"}"].concat();
    let bytes = add_signatures("a role", &envelope, &[key()]).unwrap_or(envelope);
    let mut source = Files(repository().clone());
    source.0.insert(REPLACED[usize::from(role % 4)].to_owned(), bytes);
    let mut kept = Kept::from_root(&source.0["1.root.json"]).expect("an honest root");
    let Ok(trusted) = refresh(&mut kept, &mut source, 1_800_000_000) else { return false };
    for path in ["manifest", "scene/manifest"] {
        if let Some(target) = trusted.target(path) {
            std::hint::black_box((target.file_name(path).is_ok(), target.check(path, b"x").is_ok()));
        }
    }
    true
}
