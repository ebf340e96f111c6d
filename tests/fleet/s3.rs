//! A fleet over S3: moto's server, with conditional puts.

use std::process::{Command, Stdio};

use super::support::*;
use slag_tests::*;

/// A server of S3 with one bucket, stopped when dropped.
struct S3 {
    _server: Running,
    endpoint: String,
}

impl S3 {
    fn start() -> Self {
        let port = free_port();
        let program = python_with("tests/fleet").with_file_name("moto_server");
        let mut command = Command::new(program);
        command.args(["--host", "127.0.0.1", "--port", &port.to_string()]);
        // It prints a line a request, which nobody reads.
        let server = Running::start_quiet(command.stdin(Stdio::null()));
        wait_until("moto", || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok());
        let endpoint = format!("http://127.0.0.1:{port}");
        ureq::put(format!("{endpoint}/scenes")).send_empty().expect("a bucket");
        Self { _server: server, endpoint }
    }

    /// Gives a command the credentials.
    fn known_to(&self, mut command: Command) -> Command {
        command.env("AWS_ENDPOINT", &self.endpoint).env("AWS_ALLOW_HTTP", "true");
        command.env("AWS_ACCESS_KEY_ID", "robot").env("AWS_SECRET_ACCESS_KEY", "secret");
        command.env("AWS_REGION", "us-east-1");
        command
    }
}

/// A coordinator is fenced by a second one, and a worker is killed; puts of the bucket decide, and ranges are read from it.
#[test]
fn s3_fences_a_coordinator_and_gives_the_same_bytes() {
    let s3 = S3::start();
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
    let list = |prefix: &str| {
        let url = format!("{}/scenes?list-type=2&prefix=room/{prefix}", s3.endpoint);
        let listed = ureq::get(url).call().expect("lists").body_mut().read_to_string().expect("text");
        listed.matches("<Key>").count()
    };
    let first = coordinate("first");
    wait_until("a plan", || list("jobs/00000001/plan.json") == 1);
    let second = coordinate("second");
    let fenced = first.output();
    let errors = String::from_utf8_lossy(&[fenced.stdout, fenced.stderr].concat()).into_owned();
    assert_eq!(fenced.status.code(), Some(1), "{errors}");
    assert!(errors.contains("superseded") && !scene.path("first/manifest").exists(), "{errors}");

    let killed = share("0");
    wait_until("a first view", || list("views/") > 0);
    killed.kill();
    let n_of_killed = list("views/");
    let report = share("1").json();
    let summary = second.json();
    assert_eq!(report["n_views"], N_VIEWS - n_of_killed, "{report}");
    assert_eq!(report["n_cells"], summary["n_cells"], "{report}");
    scene.assert_same("second");
}
