//! A fleet over S3: two servers that nobody here wrote, with conditional puts.

use std::process::Command;

use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto::Builder;
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;

use super::support::*;

const KEY: &str = "robot";
const SECRET: &str = "secret";

/// A server of S3 with a bucket named `scenes`.
trait S3 {
    /// Returns the port of this machine that it listens on.
    fn port(&self) -> u16;

    /// Returns its address.
    fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.port())
    }

    /// Returns the number of objects whose key starts with `room/` and a prefix that ends with `/` or is a key.
    fn n_objects(&self, prefix: &str) -> usize;

    /// Gives a command the credentials.
    fn known_to(&self, mut command: Command) -> Command {
        command.env("AWS_ENDPOINT", self.endpoint()).env("AWS_ALLOW_HTTP", "true");
        command.env("AWS_ACCESS_KEY_ID", KEY).env("AWS_SECRET_ACCESS_KEY", SECRET);
        command.env("AWS_REGION", "us-east-1");
        command
    }
}

/// moto, stopped when dropped. It believes every signature.
struct Moto {
    _server: Running,
    port: u16,
}

impl Moto {
    fn start() -> Self {
        let port = free_port();
        let args = ["--host", "127.0.0.1", "--port", &port.to_string()];
        let moto = Self { _server: start_server("moto_server", port, &args), port };
        ureq::put(format!("{}/scenes", moto.endpoint())).send_empty().expect("a bucket");
        moto
    }
}

impl S3 for Moto {
    fn port(&self) -> u16 {
        self.port
    }

    fn n_objects(&self, prefix: &str) -> usize {
        let url = format!("{}/scenes?list-type=2&prefix=room/{prefix}", self.endpoint());
        let listed = ureq::get(url).call().expect("lists").body_mut().read_to_string().expect("text");
        listed.matches("<Key>").count()
    }
}

/// s3s-fs, in threads of this process. It checks signatures, and keeps an object as a file.
struct S3s {
    runtime: Option<tokio::runtime::Runtime>,
    dir: tempfile::TempDir,
    port: u16,
}

impl S3s {
    fn start() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        fs_err::create_dir(dir.path().join("scenes")).expect("a bucket");
        let mut service = S3ServiceBuilder::new(s3s_fs::FileSystem::new(dir.path()).expect("opens"));
        service.set_auth(SimpleAuth::from_single(KEY, SECRET));
        let service = service.build();
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().expect("runs");
        let listener = runtime.block_on(tokio::net::TcpListener::bind(("127.0.0.1", 0))).expect("binds");
        let port = listener.local_addr().expect("an address").port();
        runtime.spawn(async move {
            while let Ok((socket, _)) = listener.accept().await {
                let service = service.clone();
                tokio::spawn(async move {
                    let http = Builder::new(TokioExecutor::new());
                    // A killed worker breaks its connection.
                    let _ = http.serve_connection(TokioIo::new(socket), service).await;
                });
            }
        });
        Self { runtime: Some(runtime), dir, port }
    }
}

impl Drop for S3s {
    fn drop(&mut self) {
        // Without waiting for open connections.
        self.runtime.take().into_iter().for_each(tokio::runtime::Runtime::shutdown_background);
    }
}

impl S3 for S3s {
    fn port(&self) -> u16 {
        self.port
    }

    fn n_objects(&self, prefix: &str) -> usize {
        let path = self.dir.path().join("scenes/room").join(prefix);
        if path.is_file() { 1 } else { n_objects(&path) }
    }
}

/// A coordinator is fenced by a second one, and a worker is killed; puts of the bucket decide.
fn fences_a_coordinator_and_gives_the_same_bytes(s3: &dyn S3) {
    let scene = Scene::new();
    let bucket = "s3://scenes/room";
    let coordinate = |store: &str| {
        let mut command = s3.known_to(scene.encode(store));
        Running::start(command.args(["--blobs", bucket]))
    };
    let share = |index: &str| {
        let mut worker = s3.known_to(worker(bucket));
        worker.args(["--index", index, "--of", "2", "--help-after", "0.5", "--threads", "1"]);
        Running::start(&mut worker)
    };
    let first = coordinate("first");
    wait_until("a plan", || s3.n_objects("jobs/00000001/plan.json") == 1);
    let second = coordinate("second");
    let fenced = first.output();
    let errors = String::from_utf8_lossy(&[fenced.stdout, fenced.stderr].concat()).into_owned();
    assert_eq!(fenced.status.code(), Some(1), "{errors}");
    assert!(errors.contains("superseded") && !scene.path("first/manifest").exists(), "{errors}");

    let killed = share("0");
    wait_until("a first view", || s3.n_objects("views/") > 0);
    killed.kill();
    let n_of_killed = s3.n_objects("views/");
    let report = share("1").json();
    second.json();
    assert_eq!(report["n_views"], N_VIEWS - n_of_killed, "{report}");
    scene.assert_same("second");
}

#[test]
fn moto_fences_a_coordinator_and_gives_the_same_bytes() {
    fences_a_coordinator_and_gives_the_same_bytes(&Moto::start());
}

#[test]
fn s3s_fences_a_coordinator_and_gives_the_same_bytes() {
    fences_a_coordinator_and_gives_the_same_bytes(&S3s::start());
}
