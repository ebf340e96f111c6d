//! A fleet over the server of `encoder/deploy/nats.conf`: TLS, and a key for each role.

use super::*;

use nkeys::KeyPair;
use slag_tests::*;

use super::support::*;

/// nats-server with the shipped configuration, except for port, folders and keys.
struct Secured {
    _server: Running,
    authority: Authority,
    scene: Scene,
    port: u16,
}

impl Secured {
    fn start() -> Self {
        let scene = Scene::new();
        let at = |name: &str| scene.path(name);
        let authority = Authority::new(at("ca.pem"));
        authority.issue(&at("server.pem"), &at("server.key"));
        let port = free_port();
        let mut conf = fs_err::read_to_string(root().join("encoder/deploy/nats.conf")).expect("there");
        let mut set = |from: &str, to: &str| {
            assert_eq!(conf.matches(from).count(), 1, "{from}");
            conf = conf.replace(from, to);
        };
        set("0.0.0.0:4222", &format!("127.0.0.1:{port}"));
        set("store_dir: nats", &format!("store_dir: {:?}", text(&at("nats"))));
        set("cert_file: server.pem", &format!("cert_file: {:?}", text(&at("server.pem"))));
        set("key_file: server.key", &format!("key_file: {:?}", text(&at("server.key"))));
        for (role, name) in [("UCOORDINATOR", "coordinator.nk"), ("UWORKER", "worker.nk")] {
            let key = KeyPair::new_user();
            fs_err::write(at(name), key.seed().expect("made here")).expect("written");
            set(role, &key.public_key());
        }
        fs_err::write(at("other.nk"), KeyPair::new_user().seed().expect("made here")).expect("written");
        fs_err::write(at("nats.conf"), conf).expect("written");
        let server = start_server("nats-server", port, &["--config", text(&at("nats.conf"))]);
        Self { _server: server, authority, scene, port }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.scene.path(name)
    }

    fn with_key(&self, mut command: Command, key: &str) -> Command {
        command.args(["--fleet", &format!("tls://127.0.0.1:{}", self.port)]);
        command.args(["--nats-ca", text(&self.authority.file), "--nats-nkey", text(&self.path(key))]);
        command
    }

    fn coordinator(&self, key: &str) -> Command {
        let mut command = self.scene.encode("store");
        command.args(["--blobs", text(&self.path("bucket"))]);
        self.with_key(command, key)
    }

    fn worker(&self, key: &str) -> Command {
        let mut command = worker(text(&self.path("bucket")));
        command.args(["--threads", "1"]);
        self.with_key(command, key)
    }
}

/// Each role works with its key; a worker's key cannot fill a queue; unknown keys and authorities can do nothing.
#[nightly("starts servers, and fails parts of a fleet")]
fn each_role_has_its_key_and_no_more() {
    let fleet = Secured::start();
    let refused = |mut command: Command, expected: &str| {
        let output = command.output().expect("runs");
        let errors = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        assert!(output.status.code() == Some(1) && errors.contains(expected), "{errors}");
    };
    refused(fleet.coordinator("other.nk"), "authorization violation");
    let mut stranger = fleet.scene.encode("store");
    stranger.args([
        "--blobs",
        text(&fleet.path("bucket")),
        "--nats-nkey",
        text(&fleet.path("coordinator.nk")),
    ]);
    stranger.args(["--fleet", &format!("tls://127.0.0.1:{}", fleet.port)]);
    refused(stranger, "certificate");

    // The server does not answer forbidden requests; the coordinator reports that and retries until it is stopped.
    let mut weak = Running::start(&mut fleet.coordinator("worker.nk"));
    std::thread::sleep(std::time::Duration::from_secs(7));
    weak.signal("INT");
    let warnings = String::from_utf8_lossy(&weak.output().stderr).into_owned();
    assert!(warnings.contains("the queue is looked at again"), "{warnings}");

    let coordinator = Running::start(&mut fleet.coordinator("coordinator.nk"));
    let worker = Running::start(&mut fleet.worker("worker.nk"));
    assert_eq!(coordinator.json()["n_views"], N_VIEWS);
    assert_eq!(worker.json()["n_views"], N_VIEWS);
    fleet.scene.assert_same("store");
}
