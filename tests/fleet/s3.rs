//! A fleet over S3: another project's server, with conditional puts.

use super::*;

use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto::Builder;
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;

use super::support::*;

const KEY: &str = "robot";
const SECRET: &str = "secret";

/// s3s-fs with a bucket named `scenes`, in threads of this process. It checks signatures and stores objects as files.
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

    fn n_objects(&self, prefix: &str) -> usize {
        let path = self.dir.path().join("scenes").join(prefix);
        if path.is_file() { 1 } else { n_objects(&path) }
    }

    /// Sets the address and credentials.
    fn known_to(&self, mut command: Command) -> Command {
        command.env("AWS_ENDPOINT", format!("http://127.0.0.1:{}", self.port)).env("AWS_ALLOW_HTTP", "true");
        command.env("AWS_ACCESS_KEY_ID", KEY).env("AWS_SECRET_ACCESS_KEY", SECRET);
        command.env("AWS_REGION", "us-east-1");
        command
    }
}

impl Drop for S3s {
    fn drop(&mut self) {
        self.runtime.take().into_iter().for_each(tokio::runtime::Runtime::shutdown_background);
    }
}

/// A second coordinator fences the first by conditional puts. Another fleet in the same bucket conforms.
#[test]
fn a_bucket_of_s3_fences_and_conforms() {
    let (scene, s3) = (Scene::new(), S3s::start());
    let coordinator = |bucket: &str, store: &str| {
        let mut command = s3.known_to(scene.encode(store));
        command.args(["--blobs", bucket]);
        command
    };
    let first = Running::start(&mut coordinator("s3://scenes/fence", "first"));
    wait_until("a plan", || s3.n_objects("fence/jobs/00000001/plan.json") == 1);
    let second = Running::start(&mut coordinator("s3://scenes/fence", "second"));
    let fenced = first.output();
    let errors = String::from_utf8_lossy(&[fenced.stdout, fenced.stderr].concat()).into_owned();
    assert_eq!(fenced.status.code(), Some(1), "{errors}");
    assert!(errors.contains("superseded") && !scene.path("first/manifest").exists(), "{errors}");
    drop(second);
    let share = |number: usize| with_share(s3.known_to(worker("s3://scenes/room")), number);
    let n_views = || s3.n_objects("room/views/");
    conforms(&scene, |store| coordinator("s3://scenes/room", store), share, n_views);
}
