//! Runs the programs as a user does.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use serde_json::Value;
use slag_common::shard::Profile;

use super::error::TradeoffError;
use super::grid::{Equipment, LabelledScene, Point};

/// Number of Gaussians that a timed query returns.
const QUERY_LIMIT: &str = "1000";
/// Timed queries.
const QUERY_RUNS: &str = "40";

/// Paths of the programs and their common flags.
#[derive(Clone, Debug)]
pub struct Programs {
    /// `slag-encoder`.
    pub encoder: PathBuf,
    /// `slag-lab`: this program.
    pub lab: PathBuf,
    /// `slag-edge`; without it queries are not timed.
    pub edge: Option<PathBuf>,
    /// Flags that select the models and their runtime.
    pub models: Vec<String>,
    /// Version, models and device in words.
    pub made_by: String,
    /// What placeholders of flags stand for.
    pub equipment: Equipment,
}

/// The runs of one point.
pub(super) struct Runs<'a> {
    programs: &'a Programs,
    scene: &'a LabelledScene,
    point: &'a Point,
}

impl Programs {
    pub(super) fn of<'a>(&'a self, scene: &'a LabelledScene, point: &'a Point) -> Runs<'a> {
        Runs { programs: self, scene, point }
    }
}

impl Runs<'_> {
    /// Encodes the scene and returns the summary; the views' contributions are kept.
    pub(super) fn encode(
        &self,
        store: &Path,
        views: &[String],
        lift: &[String],
    ) -> Result<Value, TradeoffError> {
        let mut command = Command::new(&self.programs.encoder);
        command.args(["--json", "encode", "--metric", "--keep-views", "--scene"]).arg(&self.scene.splat);
        command.arg("--views").arg(&self.scene.poses).arg("--store").arg(store);
        self.run(command.args(&self.programs.models).args(views).args(lift))
    }

    /// Evaluates the store's shards of a profile.
    pub(super) fn evaluate(
        &self,
        store: &Path,
        profile: Profile,
        eval: &[String],
    ) -> Result<Value, TradeoffError> {
        let mut command = Command::new(&self.programs.lab);
        command.args(["--json", "eval", "labelled", "--scene"]).arg(&self.scene.splat);
        command.arg("--truth").arg(&self.scene.dir).arg("--store").arg(store);
        self.run(command.args(["--profile", profile.name()]).args(&self.programs.models).args(eval))
    }

    /// Fetches the shards as a robot does, and times queries on them.
    pub(super) fn query_ms(
        &self,
        store: &Path,
        out: &Path,
        profile: Profile,
    ) -> Result<Option<f64>, TradeoffError> {
        let Some(edge) = &self.programs.edge else { return Ok(None) };
        let cache = out.join("cache");
        remove(&cache)?;
        let mut command = Command::new(&self.programs.encoder);
        command.args(["--quiet", "serve", "--listen", "127.0.0.1:0", "--store"]).arg(store);
        let mut server = Server(command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?);
        let mut line = String::new();
        if let Some(stdout) = server.0.stdout.take() {
            BufReader::new(stdout).read_line(&mut line)?;
        }
        let url = line.trim().strip_prefix("listening on ");
        let url =
            url.ok_or_else(|| self.failed(&command, format!("expected its address, found {line:?}")))?;
        let mut fetch = Command::new(edge);
        fetch.args(["fetch", "--json", "--quiet", "--at", "0,0,0", "--radius", "1e6", "--from", url]);
        self.run(fetch.args(["--profile", profile.name(), "--cache"]).arg(&cache))?;
        drop(server);
        let mut bench = Command::new(edge);
        bench.args([
            "bench",
            "query",
            "--limits",
            QUERY_LIMIT,
            "--runs",
            QUERY_RUNS,
            "--precision",
            "measured",
        ]);
        let timed = self.run(bench.arg("--cache").arg(&cache))?;
        remove(&cache)?;
        let kinds = timed["in_process"].as_array().into_iter().flatten();
        Ok(kinds.filter(|kind| kind["kind"] == "best").find_map(|kind| kind["median_ms"].as_f64()))
    }

    /// Runs a command and parses the JSON it prints.
    fn run(&self, command: &mut Command) -> Result<Value, TradeoffError> {
        let output = command.stdin(Stdio::null()).output()?;
        let printed: Option<Value> = serde_json::from_slice(&output.stdout).ok();
        let message = printed.as_ref().and_then(|value| value["error"]["message"].as_str());
        // Exit code 3: some inputs were left out; the figures count them.
        match (printed.as_ref(), message, output.status.code()) {
            (Some(value), None, Some(0 | 3)) => Ok(value.clone()),
            (_, Some(message), _) => Err(self.failed(command, message.to_owned())),
            _ => Err(self.failed(command, String::from_utf8_lossy(&output.stderr).trim().to_owned())),
        }
    }

    /// Returns a figure that a program printed.
    pub(super) fn figure(&self, printed: &Value, name: &str) -> Result<f64, TradeoffError> {
        let missing = || {
            self.error("output".into(), format!("no {name} in the JSON: the flags leave nothing to measure"))
        };
        printed[name].as_f64().ok_or_else(missing)
    }

    fn failed(&self, command: &Command, message: String) -> TradeoffError {
        let words = std::iter::once(command.get_program()).chain(command.get_args());
        self.error(words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" "), message)
    }

    fn error(&self, command: String, message: String) -> TradeoffError {
        TradeoffError::Program {
            scene: self.scene.name.clone(),
            axis: self.point.axis.clone(),
            name: self.point.name.clone(),
            command,
            message,
        }
    }
}

/// A service that is stopped when dropped.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Removes a folder where it exists.
pub(super) fn remove(store: &Path) -> std::io::Result<()> {
    if store.exists() { fs_err::remove_dir_all(store) } else { Ok(()) }
}
