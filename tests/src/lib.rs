//! Shared by the end-to-end tests: programs, shared data, accuracy measures.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
pub use slag_test_support::{needs_shared, nightly, npz_array, shared, trials};

mod authority;
mod made;
mod python;
mod site;

pub use authority::Authority;
pub use made::{encoded, encoded_into, generated, made};
pub use python::{judge, python_with};
pub use site::{ROOM, SITE, Site};

/// Folders with source files.
const OURS: [&str; 7] = ["common", "encoder", "edge", "doors", "packaging", "tests", "fuzz"];

pub fn root() -> PathBuf {
    slag_test_support::workspace_root()
}

/// Returns a program of the project, built like the tests.
///
/// `./test.sh` builds all programs first and sets `SLAG_PROGRAMS_ARE_BUILT`; without it they are built here,
/// because a part of the tests may run alone.
pub fn program(name: &str) -> PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let folder = BUILT.get_or_init(|| {
        // target/PROFILE/deps/this-test
        let exe = std::env::current_exe().expect("a test has a path");
        let folder = exe.ancestors().nth(2).expect("tests lie in target/PROFILE/deps").to_owned();
        if std::env::var_os("SLAG_PROGRAMS_ARE_BUILT").is_none() {
            let mut build = Command::new(env!("CARGO"));
            build.current_dir(root()).args(["build", "--workspace", "--bins", "--locked"]);
            // Set by scripts/timed-test.sh; with it, cargo would rebuild what depends on it.
            build.env_remove("RUSTC_BOOTSTRAP");
            if folder.ends_with("release") {
                build.arg("--release");
            }
            assert!(build.status().expect("cargo runs").success(), "the programs do not build");
        }
        folder
    });
    folder.join(name)
}

pub fn encoder(args: &[&str]) -> Command {
    command("slag-encoder", args)
}

pub fn lab(args: &[&str]) -> Command {
    command("slag-lab", args)
}

pub fn edge(args: &[&str]) -> Command {
    let mut command = command("slag-edge", args);
    // Ignores this machine's own configuration.
    command.env("SLAG_EDGE_CONFIG", "");
    command
}

fn command(name: &str, args: &[&str]) -> Command {
    let mut command = Command::new(program(name));
    command.args(args).stdin(Stdio::null());
    command
}

/// Runs a command that must succeed.
pub fn run(command: &mut Command) -> Output {
    let output = command.output().expect("the program starts");
    assert!(
        output.status.success(),
        "{command:?}: {}\n{}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

/// Runs a command that must fail with `expected` in its output, which is returned.
pub fn refused(command: &mut Command, expected: &str) -> String {
    let output = command.output().expect("the program starts");
    let printed = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert_eq!(output.status.code(), Some(1), "{command:?}: {printed}");
    assert!(printed.contains(expected), "{command:?}: {expected} is not in {printed}");
    printed
}

/// Runs a command that must succeed; returns the JSON object that it prints.
pub fn run_json(command: &mut Command) -> Value {
    let output = run(command.arg("--json"));
    serde_json::from_slice(&output.stdout).expect("one JSON object on stdout")
}

/// Encodes a generated room into a store, with cells small enough for several.
pub fn encode_room(room: &Path, store: &Path) -> Command {
    let (scene, views) = (room.join("scene.ply"), room.join("transforms.json"));
    let mut command = encoder(&["encode", "--scene", text(&scene), "--views", text(&views), "--metric"]);
    command.args(["--cell-gaussians", "4096", "--store", text(store), "--json"]);
    command.env("SOURCE_DATE_EPOCH", "1700000000");
    command
}

/// Fetches the middle of a generated room to a robot without prior trust.
pub fn fetch(from: &str, cache: &Path) -> Command {
    let mut command =
        edge(&["fetch", "--trust-first", "--from", from, "--at", "3.5,2.7,0", "--radius", "50"]);
    command.arg("--cache").arg(cache);
    command
}

pub fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&fs_err::read(path).expect("the file is there")).expect("JSON")
}

/// Like [`encode_room`], with true masks and small rasters, in a fifth of the time.
pub fn encode_quickly(room: &Path, store: &Path) -> Command {
    let mut command = encode_room(room, store);
    command.args(["--masks", text(&room.join("gt/masks")), "--raster-width", "320"]);
    command
}

pub fn copy_dir(from: &Path, to: &Path) {
    fs_err::create_dir_all(to).expect("made");
    for entry in fs_err::read_dir(from).expect("there") {
        let entry = entry.expect("readable");
        let target = to.join(entry.file_name());
        match entry.file_type().expect("known").is_dir() {
            true => copy_dir(&entry.path(), &target),
            false => drop(fs_err::copy(entry.path(), target).expect("copied")),
        }
    }
}

/// Sorted by path.
pub fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> =
        fs_err::read_dir(folder).expect("a folder").map(|entry| entry.expect("readable").path()).collect();
    paths.sort();
    paths.into_iter().flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

/// Files of the project's own folders with an extension, without built or installed ones.
pub fn sources(extension: &str) -> Vec<PathBuf> {
    let is_made =
        |path: &Path| ["target", "node_modules", "dist"].map(Path::new).iter().any(|of| path.ends_with(of));
    let mut found = Vec::new();
    let mut waiting: Vec<PathBuf> = OURS.iter().map(|folder| root().join(folder)).collect();
    while let Some(path) = waiting.pop() {
        if !path.is_dir() {
            found.extend(Some(path).filter(|path| path.extension().is_some_and(|of| of == extension)));
        } else if !is_made(&path) {
            waiting.extend(fs_err::read_dir(path).unwrap().map(|entry| entry.unwrap().path()));
        }
    }
    found.sort();
    found
}

/// A service, stopped when dropped.
pub struct Service {
    child: Child,
    pub url: String,
}

impl Service {
    /// Starts a service of ours on a free port and waits until it listens.
    pub fn start(command: &mut Command) -> Self {
        Self::start_as(command.args(["--listen", "127.0.0.1:0"]))
    }

    /// Starts a service that prints its address, and waits until it does.
    pub fn start_as(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("starts");
        let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut seen = String::new();
        let url = loop {
            let line = lines.next().unwrap_or_else(|| panic!("ended before it listened: {seen}")).unwrap();
            if let Some(at) = line.find("http") {
                let url = line[at..].split_whitespace().next().expect("a URL");
                break url.trim_end_matches(['/', ')']).to_owned();
            }
            seen += &line;
        };
        // Keeps the pipe from filling up.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, url }
    }

    /// Serves a folder of static files with Python.
    pub fn of_files(folder: &Path) -> Self {
        let mut python = Command::new("python3");
        python.args("-u -m http.server 0 --bind 127.0.0.1 --directory".split(' ')).arg(folder);
        Self::start_as(python.stderr(Stdio::null()))
    }

    pub fn get(&self, path: &str) -> Value {
        let text = ureq::get(format!("{}{path}", self.url)).call().unwrap().body_mut().read_to_string();
        serde_json::from_str(&text.expect("text")).expect("JSON")
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Words of a command line; text in quotes is one word.
pub fn words(line: &str) -> Vec<String> {
    let parts = line.split('"').enumerate();
    let words = parts.flat_map(|(at, part)| match at % 2 {
        1 => vec![part],
        _ => part.split_whitespace().collect(),
    });
    words.map(str::to_owned).collect()
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("test paths are UTF-8")
}

pub fn read_npy<T: npyz::Deserialize>(path: &Path) -> Vec<T> {
    let bytes = fs_err::read(path).expect("the array is there");
    npyz::NpyFile::new(&bytes[..]).expect("a NumPy array").into_vec().expect("of the type asked for")
}

/// Hashes of all shards and fields of a store, by role: they must not depend on the run.
pub fn content(store: &Path) -> Vec<(String, String)> {
    let manifest = read_json(&store.join("manifest"));
    let mut content = Vec::new();
    for cell in manifest["cells"].as_array().expect("cells") {
        for (profile, shard) in cell["shards"].as_object().expect("shards") {
            content.push((format!("{}/{profile}", cell["cell_id"]), shard["hash"].to_string()));
        }
    }
    content
}
