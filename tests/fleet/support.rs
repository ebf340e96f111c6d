//! A scene, the store that one process makes of it, and the programs of a fleet.

use super::*;
use std::path::Path;
use std::process::{Child, Output, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
use slag_tests::*;

const MODELS: [&str; 4] = ["--models", "colours", "--device", "cpu"];

/// One profile, so that codebooks take less time than views.
const ENCODE: [&str; 5] = ["--name", "room", "--profiles", "compact", "--photo-poses"];

pub const N_VIEWS: usize = 6;

/// A generated room, which all tests encode, and the folder of one test.
pub struct Scene {
    dir: tempfile::TempDir,
}

impl Scene {
    pub fn new() -> Self {
        Self { dir: tempfile::tempdir().expect("a temporary folder") }
    }

    fn room() -> &'static (PathBuf, Vec<u8>) {
        static ROOM: OnceLock<(PathBuf, Vec<u8>)> = OnceLock::new();
        ROOM.get_or_init(|| {
            // Beside the built programs, because statics are not dropped. Several programs may run seeded faults.
            let seed = std::env::var("SLAG_FAULT_SEED").unwrap_or_default();
            let dir = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fleet{seed}"));
            if dir.exists() {
                fs_err::remove_dir_all(&dir).expect("removed");
            }
            let (room, alone) = (dir.join("room"), dir.join("alone"));
            run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", &N_VIEWS.to_string()]));
            run(encode_room(&room, &alone).args(MODELS).args(ENCODE));
            let manifest = fs_err::read(alone.join("manifest")).expect("published");
            (room, manifest)
        })
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub fn encode(&self, store: &str) -> Command {
        let mut command = encode_room(&Self::room().0, &self.path(store));
        command.args(MODELS).args(ENCODE);
        command
    }

    /// Fails unless a store has the manifest and objects of the one made by a single process.
    pub fn assert_same(&self, store: &str) {
        self.assert_has(store, &Self::room().1);
    }

    /// Fails unless a store has this manifest and its objects.
    pub fn assert_has(&self, store: &str, expected: &[u8]) {
        let manifest = fs_err::read(self.path(store).join("manifest")).expect("published");
        assert!(manifest == expected, "{store}: another manifest than one process makes");
        run(&mut encoder(&["store", "verify", "--store", text(&self.path(store))]));
    }
}

/// `bucket`: an address.
pub fn worker(bucket: &str) -> Command {
    let mut command = encoder(&["worker", "--json", "--blobs", bucket, "--wait", "30"]);
    command.args(MODELS);
    command
}

/// Assigns one of two shares.
pub fn with_share(mut worker: Command, number: usize) -> Command {
    worker.args(["--index", &number.to_string(), "--of", "2", "--help-after", "0.3", "--threads", "1"]);
    worker
}

/// A program in the background, killed when dropped.
pub struct Running {
    child: Option<Child>,
    what: String,
}

impl Running {
    pub fn start(command: &mut Command) -> Self {
        let what = format!("{command:?}");
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
        Self { child: Some(child), what }
    }

    fn child(&mut self) -> &mut Child {
        self.child.as_mut().expect("it runs")
    }

    pub fn is_running(&mut self) -> bool {
        self.child().try_wait().expect("waits").is_none()
    }

    pub fn kill(mut self) {
        assert!(self.is_running(), "{} has ended", self.what);
        self.child().kill().expect("killed");
        self.child().wait().expect("waits");
        self.child = None;
    }

    pub fn id(&mut self) -> String {
        self.child().id().to_string()
    }

    pub fn signal(&mut self, name: &str) {
        run(Command::new("kill").args(["-s", name, &self.id()]));
    }

    pub fn output(mut self) -> Output {
        self.child.take().expect("it runs").wait_with_output().expect("waits")
    }

    /// Waits for its successful end; returns the JSON that it prints.
    pub fn json(self) -> Value {
        let what = self.what.clone();
        let output = self.output();
        let (printed, errors) =
            (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.success(), "{what}: {}\n{errors}\n{printed}", output.status);
        serde_json::from_slice(&output.stdout).expect("one JSON object on stdout")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(mut child) = self.child.take() {
            // It may have ended by itself.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

pub fn n_objects(folder: &Path) -> usize {
    // An unfinished object has a `#` in its name, and a killed worker leaves it.
    let is_whole = |entry: &std::io::Result<std::fs::DirEntry>| {
        entry.as_ref().is_ok_and(|entry| !entry.file_name().to_string_lossy().contains('#'))
    };
    std::fs::read_dir(folder).map_or(0, |entries| entries.filter(is_whole).count())
}

/// Waits until a condition holds.
///
/// # Panics
/// After a minute.
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    for _ in 0..12_000 {
        if is_so() {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("{what}: not after a minute");
}

/// Starts a server from a Python package; returns it once it listens on its port. Its output is not read.
pub fn start_server(name: &str, port: u16, args: &[&str]) -> Running {
    let mut command = Command::new(python_with("tests/fleet").with_file_name(name));
    let child = command.args(args).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    let server = Running { child: Some(child.expect("starts")), what: name.to_owned() };
    wait_until(name, || std::net::TcpStream::connect(("127.0.0.1", port)).is_ok());
    server
}

pub fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("binds");
    listener.local_addr().expect("an address").port()
}
