//! What the end-to-end tests share: the programs, the data beside the project, and accuracy measures.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
pub use slag_test_support::{needs_shared, shared};

mod authority;
mod python;
mod site;

pub use authority::Authority;
pub use python::{judge, python_with};
pub use site::Site;

/// Returns the project's root.
pub fn root() -> PathBuf {
    slag_test_support::workspace_root()
}

/// Returns a program of the project, built as the tests are.
///
/// `cargo test --workspace` builds all programs before the tests; `./test.sh` says so by `SLAG_PROGRAMS_ARE_BUILT`.
/// Without that variable the programs are built first: a part of the tests may run alone.
pub fn program(name: &str) -> PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let folder = BUILT.get_or_init(|| {
        // target/PROFILE/deps/this-test
        let exe = std::env::current_exe().expect("a test has a path");
        let folder = exe.ancestors().nth(2).expect("tests lie in target/PROFILE/deps").to_owned();
        if std::env::var_os("SLAG_PROGRAMS_ARE_BUILT").is_none() {
            let mut build = Command::new(env!("CARGO"));
            build.current_dir(root()).args(["build", "--workspace", "--bins", "--locked"]);
            if folder.ends_with("release") {
                build.arg("--release");
            }
            assert!(build.status().expect("cargo runs").success(), "the programs do not build");
        }
        folder
    });
    folder.join(name)
}

/// Returns a command of the encoder.
pub fn encoder(args: &[&str]) -> Command {
    command("slag-encoder", args)
}

/// Returns a command of the laboratory.
pub fn lab(args: &[&str]) -> Command {
    command("slag-lab", args)
}

/// Returns a command of the robot's program.
pub fn edge(args: &[&str]) -> Command {
    let mut command = command("slag-edge", args);
    // Not this machine's own configuration.
    command.env("SLAG_EDGE_CONFIG", "");
    command
}

fn command(name: &str, args: &[&str]) -> Command {
    let mut command = Command::new(program(name));
    command.args(args).stdin(Stdio::null());
    command
}

/// Runs a command that must succeed and returns its output.
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

/// Runs a command that must succeed and returns the JSON object that it prints.
pub fn run_json(command: &mut Command) -> Value {
    let output = run(command.arg("--json"));
    serde_json::from_slice(&output.stdout).expect("one JSON object on stdout")
}

/// Returns the command that encodes a generated room into a store, in cells small enough that there are several.
pub fn encode_room(room: &Path, store: &Path) -> Command {
    let (scene, views) = (room.join("scene.ply"), room.join("transforms.json"));
    let mut command = encoder(&["encode", "--scene", text(&scene), "--views", text(&views), "--metric"]);
    command.args(["--cell-gaussians", "4096", "--store", text(store), "--json"]);
    command.env("SOURCE_DATE_EPOCH", "1700000000");
    command
}

/// Copies a folder with all that is in it.
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

/// A service, stopped when dropped.
pub struct Service {
    child: Child,
    /// Where it listens.
    pub url: String,
}

impl Service {
    /// Starts a service of ours on a free port and waits until it listens.
    pub fn start(command: &mut Command) -> Self {
        Self::start_as(command.args(["--listen", "127.0.0.1:0"]))
    }

    /// Starts any service that prints its address, and waits until it does.
    pub fn start_as(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().expect("starts");
        let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut seen = String::new();
        let url = loop {
            let line =
                lines.next().unwrap_or_else(|| panic!("ended before it listened: {seen}")).expect("text");
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

    /// Returns a resource as JSON.
    pub fn get(&self, path: &str) -> Value {
        let text =
            ureq::get(format!("{}{path}", self.url)).call().expect("answers").body_mut().read_to_string();
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

/// Returns a path as text, for a command line.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("test paths are UTF-8")
}

/// Reads a NumPy array.
pub fn read_npy<T: npyz::Deserialize>(path: &Path) -> Vec<T> {
    let bytes = fs_err::read(path).expect("the array is there");
    npyz::NpyFile::new(&bytes[..]).expect("a NumPy array").into_vec().expect("of the type asked for")
}

/// Returns the hashes of all shards and fields of a store, by role: what must not depend on the run.
pub fn content(store: &Path) -> Vec<(String, String)> {
    let manifest = fs_err::read(store.join("manifest")).expect("a published store");
    let manifest: Value = serde_json::from_slice(&manifest).expect("JSON");
    let mut content = Vec::new();
    for cell in manifest["cells"].as_array().expect("cells") {
        for (profile, shard) in cell["shards"].as_object().expect("shards") {
            content.push((format!("{}/{profile}", cell["cell_id"]), shard["hash"].to_string()));
        }
    }
    content
}

/// Returns the area under the ROC curve: the chance that a positive scores above a negative, ties
/// counting half (Mann and Whitney 1947).
pub fn roc_auc(scores: &[f32], positive: &[bool]) -> f64 {
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|a, b| scores[*a].total_cmp(&scores[*b]));
    let n_positive = positive.iter().filter(|p| **p).count() as f64;
    let n_negative = scores.len() as f64 - n_positive;
    let mut rank_sum = 0.0;
    let mut rank = 0.0;
    for tied in order.chunk_by(|a, b| scores[*a] == scores[*b]) {
        let mean_rank = rank + (tied.len() as f64 + 1.0) / 2.0;
        rank_sum += mean_rank * tied.iter().filter(|i| positive[**i]).count() as f64;
        rank += tied.len() as f64;
    }
    (rank_sum - n_positive * (n_positive + 1.0) / 2.0) / (n_positive * n_negative)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: all pairs.
    #[test]
    fn auc_equals_counting_pairs() {
        let scores = [0.1f32, 0.4, 0.4, 0.8, 0.35, 0.4, 0.9];
        let positive = [false, true, false, true, false, true, false];
        let mut won = 0.0;
        let mut pairs = 0.0;
        for i in 0..7 {
            for j in 0..7 {
                if positive[i] && !positive[j] {
                    pairs += 1.0;
                    won += if scores[i] > scores[j] {
                        1.0
                    } else if scores[i] == scores[j] {
                        0.5
                    } else {
                        0.0
                    };
                }
            }
        }
        assert!((roc_auc(&scores, &positive) - won / pairs).abs() < 1e-12);
    }
}
