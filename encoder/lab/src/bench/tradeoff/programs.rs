//! Runs the programs as a user does.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use slag_common::shard::Profile;

use super::error::TradeoffError;
use super::grid::{Equipment, LabelledScene, Point};
use crate::bench::programs::{ProgramError, Server, json_of, remove};

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
        let fetched = Server::start(&self.programs.encoder, store)
            .and_then(|server| server.fetch_all(edge, &cache, profile));
        fetched.map_err(|error| self.of_program(error))?;
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

    fn run(&self, command: &mut Command) -> Result<Value, TradeoffError> {
        json_of(command).map_err(|error| self.of_program(error))
    }

    fn of_program(&self, error: ProgramError) -> TradeoffError {
        match error {
            ProgramError::Io(error) => error.into(),
            ProgramError::Failed { command, message } => self.error(command, message),
        }
    }

    /// Returns a figure that a program printed.
    pub(super) fn figure(&self, printed: &Value, name: &str) -> Result<f64, TradeoffError> {
        let missing = || {
            self.error("output".into(), format!("no {name} in the JSON: the flags leave nothing to measure"))
        };
        printed[name].as_f64().ok_or_else(missing)
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
