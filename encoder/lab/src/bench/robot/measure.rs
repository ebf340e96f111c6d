//! Measures engines one after the other.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};
use serde_json::Value;
use slag_common::shard::Profile;
use slag_encoder::codebook::CodebookSettings;
use slag_encoder::progress::Progress;
use slag_encoder::shard::ShardSettings;

use super::engine::Engine;
use super::report::{EngineFigures, RobotReport, SearchFigures, TextFigures};
use super::truth::Truth;
use crate::bench::field;
use crate::bench::machine::Machine;
use crate::bench::programs::{Server, json_of, load_1min, remove};

/// What to measure.
#[derive(Clone, Debug)]
pub struct RobotSettings {
    /// Numbers of Gaussians, rounded down to whole cells of the field.
    pub sizes: Vec<u64>,
    /// Components of an embedding.
    pub dim: u32,
    /// Numbers of results.
    pub limits: Vec<u64>,
    /// Engines.
    pub engines: Vec<Engine>,
    /// Timed queries of each number of results.
    pub n_runs: u32,
    /// Free memory, bytes; engines that need more are left out.
    pub free_memory_bytes: Option<u64>,
    /// Folder for the report, and for the field while it is needed.
    pub out: PathBuf,
    /// `slag-encoder`.
    pub encoder: PathBuf,
    /// `slag-edge`.
    pub edge: PathBuf,
    /// `slag-bench-rivals`.
    pub rivals: Option<PathBuf>,
    /// Flags of `slag-edge bench text` that name the text model.
    pub models: Vec<String>,
}

/// Measures what has no file in `OUT/figures` yet, and writes `robot.json` and `robot.md` for all of it.
///
/// # Errors
/// A program fails, or a file cannot be written. What was measured before is kept.
pub fn run(settings: &RobotSettings, progress: &dyn Progress) -> Result<RobotReport> {
    let (texts, no_texts) = match texts(settings) {
        Ok(texts) => (texts, None),
        Err(error) => (Vec::new(), Some(format!("text to vector: {error:#}"))),
    };
    let mut report = RobotReport {
        machine: Machine::here(),
        dim: settings.dim,
        sizes: settings.sizes.clone(),
        limits: settings.limits.clone(),
        texts,
        figures: Vec::new(),
        not_run: no_texts.into_iter().collect(),
    };
    fs_err::create_dir_all(settings.out.join("figures"))?;
    for size in &settings.sizes {
        let mut scene = Scene::new(settings, *size);
        for engine in &settings.engines {
            let path = settings.out.join(format!("figures/{}-{size}-{}.json", engine.name, settings.dim));
            if path.is_file() {
                let malformed = || format!("{}: delete the file to measure again", path.display());
                let figures = serde_json::from_slice(&fs_err::read(&path)?).with_context(malformed)?;
                report.figures.push(figures);
            } else if let Some(reason) = settings.reason_against(engine, *size) {
                report.not_run.push(format!("{} at {} M: {reason}", engine.name, *size as f64 / 1e6));
            } else {
                let figures = scene.measure(engine, progress)?;
                slag_common::durable::write(&path, &serde_json::to_vec_pretty(&figures)?)?;
                report.figures.push(figures);
            }
        }
        scene.remove()?;
    }
    fs_err::write(settings.out.join("robot.json"), serde_json::to_vec_pretty(&report)?)?;
    fs_err::write(settings.out.join("robot.md"), report.to_string())?;
    Ok(report)
}

impl RobotSettings {
    /// Returns why an engine cannot or shall not be measured at a size.
    fn reason_against(&self, engine: &Engine, n_gaussians: u64) -> Option<String> {
        if engine.most_gaussians.is_some_and(|most| n_gaussians > most) {
            return Some(format!("asked for up to {} Gaussians", engine.most_gaussians.unwrap_or(0)));
        }
        if engine.profile().is_none() && self.rivals.is_none() {
            return Some("no --rivals program is given".into());
        }
        let needed = engine.memory_bytes(n_gaussians, u64::from(self.dim));
        let free = self.free_memory_bytes?;
        let gb = |bytes: u64| bytes as f64 / 1e9;
        (needed > free).then(|| format!("needs {:.1} GB of memory, {:.1} are free", gb(needed), gb(free)))
    }

    fn limits(&self) -> String {
        self.limits.iter().map(u64::to_string).collect::<Vec<_>>().join(",")
    }
}

/// A field of one size, made when it is first needed.
struct Scene<'a> {
    settings: &'a RobotSettings,
    n_gaussians: u64,
    dir: PathBuf,
    is_published: bool,
    truth: Option<Truth>,
}

impl<'a> Scene<'a> {
    fn new(settings: &'a RobotSettings, n_gaussians: u64) -> Self {
        let dir = settings.out.join(format!("field-{n_gaussians}"));
        Self { settings, n_gaussians, dir, is_published: false, truth: None }
    }

    /// Whether other engines are measured at this size: they need the vectors.
    fn has_rivals(&self) -> bool {
        let fits =
            |e: &Engine| e.profile().is_none() && self.settings.reason_against(e, self.n_gaussians).is_none();
        self.settings.engines.iter().any(fits)
    }

    fn store(&self) -> PathBuf {
        self.dir.join("store")
    }

    fn dump(&self) -> PathBuf {
        self.dir.join("dump")
    }

    /// Publishes the field and, for other engines, writes its vectors and queries.
    fn publish(&mut self, progress: &dyn Progress) -> Result<()> {
        if self.is_published {
            return Ok(());
        }
        remove(&self.dir)?;
        let mut profiles: Vec<Profile> = self.settings.engines.iter().filter_map(Engine::profile).collect();
        let has_rivals = self.has_rivals();
        if has_rivals && !profiles.contains(&Profile::Exact) {
            profiles.push(Profile::Exact);
        }
        let shards = ShardSettings {
            profiles,
            codebook: CodebookSettings::default(),
            input_indices: false,
            appearance: false,
        };
        let (n, dim) = (self.n_gaussians as usize, self.settings.dim as usize);
        field::publish(n, dim, &self.store(), &shards, progress)?;
        if has_rivals {
            let cache = self.fetch(Profile::Exact)?;
            let mut command = Command::new(&self.settings.edge);
            command.args(["bench", "query", "--runs", "1", "--limits", "1", "--dump"]).arg(self.dump());
            json_of(command.arg("--cache").arg(&cache))?;
            if !self.settings.engines.iter().any(|e| e.profile() == Some(Profile::Exact)) {
                remove(&cache)?;
            }
            self.truth = Some(Truth::read(&self.dump(), dim, self.settings.n_runs as usize)?);
        }
        self.is_published = true;
        Ok(())
    }

    /// Fetches the shards of a profile as a robot does, and returns the cache.
    fn fetch(&self, profile: Profile) -> Result<PathBuf> {
        let cache = self.dir.join(format!("cache-{profile}"));
        if !cache.exists() {
            let server = Server::start(&self.settings.encoder, &self.store())?;
            server.fetch_all(&self.settings.edge, &cache, profile)?;
        }
        Ok(cache)
    }

    fn measure(&mut self, engine: &Engine, progress: &dyn Progress) -> Result<EngineFigures> {
        self.publish(progress)?;
        progress.begin(&engine.name, "engine", 1, 0);
        let ids = self.dir.join("ids");
        fs_err::create_dir_all(&ids)?;
        let measured = match engine.profile() {
            Some(profile) => self.of_slag(profile, &ids),
            None => self.of_rival(engine, &ids),
        };
        remove(&ids)?;
        progress.end();
        measured
    }

    fn of_slag(&self, profile: Profile, ids: &Path) -> Result<EngineFigures> {
        let settings = self.settings;
        let cache = self.fetch(profile)?;
        let mut command = Command::new(&settings.edge);
        command.args(["bench", "query", "--precision", "measured", "--limits", &settings.limits()]);
        command.args(["--runs", &settings.n_runs.to_string()]).arg("--cache").arg(&cache);
        if self.truth.is_some() {
            command.arg("--queries").arg(self.dump().join("queries.f32")).arg("--ids").arg(ids);
        }
        let load_1min = load_1min();
        let printed = json_of(&mut command)?;
        let best: Vec<&Value> =
            printed["in_process"].as_array().into_iter().flatten().filter(|t| t["kind"] == "best").collect();
        Ok(EngineFigures {
            engine: profile.name().to_owned(),
            library: "slag-edge".into(),
            n_gaussians: self.n_gaussians,
            build_secs: None,
            disk_bytes: printed["scene"]["shard_bytes"].as_u64(),
            rss_bytes: printed["memory"]["rss_bytes"].as_u64(),
            load_1min,
            searches: self.searches(&best, profile.name(), ids)?,
        })
    }

    fn of_rival(&self, engine: &Engine, ids: &Path) -> Result<EngineFigures> {
        let settings = self.settings;
        let Some(rivals) = &settings.rivals else { bail!("{}: no --rivals program is given", engine.name) };
        let mut command = Command::new(rivals);
        command.args(["--engine", &engine.name, "--limits", &settings.limits()]);
        command.args(["--runs", &settings.n_runs.to_string()]).arg("--dump").arg(self.dump());
        let load_1min = load_1min();
        let printed = json_of(command.arg("--ids").arg(ids))?;
        let searches: Vec<&Value> = printed["searches"].as_array().into_iter().flatten().collect();
        Ok(EngineFigures {
            engine: engine.name.clone(),
            library: printed["library"].as_str().unwrap_or("unknown").to_owned(),
            n_gaussians: self.n_gaussians,
            build_secs: printed["build_secs"].as_f64(),
            disk_bytes: printed["disk_bytes"].as_u64(),
            rss_bytes: printed["rss_bytes"].as_u64(),
            load_1min,
            searches: self.searches(&searches, &engine.name, ids)?,
        })
    }

    /// Reads times as both programs print them, and judges the ids that they wrote.
    fn searches(&self, printed: &[&Value], name: &str, ids: &Path) -> Result<Vec<SearchFigures>> {
        let figure = |of: &Value, key: &str| {
            of[key]
                .as_f64()
                .with_context(|| format!("{name}: no {key} in its JSON; build it from this version"))
        };
        let of_limit = |of: &&Value| {
            let limit = figure(of, "limit")? as u64;
            Ok(SearchFigures {
                limit,
                n_runs: figure(of, "n_runs")? as u64,
                min_ms: figure(of, "min_ms")?,
                median_ms: figure(of, "median_ms")?,
                p99_ms: figure(of, "p99_ms")?,
                recall: self.recall(name, limit as usize, ids)?,
            })
        };
        printed.iter().map(of_limit).collect()
    }

    /// Returns the mean recall of the queries whose ids were written.
    fn recall(&self, name: &str, limit: usize, ids: &Path) -> Result<Option<f64>> {
        let Some(truth) = &self.truth else { return Ok(None) };
        let mut recalls = Vec::new();
        for query in 0.. {
            let path = ids.join(format!("{name}-{limit}-{query}.u32"));
            if !path.is_file() {
                break;
            }
            let bytes = fs_err::read(path)?;
            let found: Vec<u32> =
                bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            match truth.recall(query, limit, &found) {
                Some(recall) => recalls.push(recall),
                None => break,
            }
        }
        Ok((!recalls.is_empty()).then(|| recalls.iter().sum::<f64>() / recalls.len() as f64))
    }

    fn remove(&self) -> Result<()> {
        Ok(remove(&self.dir)?)
    }
}

/// Times the text model.
fn texts(settings: &RobotSettings) -> Result<Vec<TextFigures>> {
    let mut command = Command::new(&settings.edge);
    let printed = json_of(command.args(["bench", "text"]).args(&settings.models))?;
    let of_text = |of: &Value| {
        Some(TextFigures {
            model: printed["model"].as_str()?.to_owned(),
            text: of["text"].as_str()?.to_owned(),
            median_ms: of["times"]["median_ms"].as_f64()?,
        })
    };
    Ok(printed["texts"].as_array().into_iter().flatten().filter_map(of_text).collect())
}
