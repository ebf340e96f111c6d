//! Generated scenes on robots, and questions to their services.

use std::fmt::Debug;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use clap::ValueEnum;
use serde_json::Value;
use slag_encoder::progress::Progress;

use super::{Service, fetch, line, sibling};
use crate::generate::compose::Walk;
use crate::generate::grammar::SceneKind;

const TIMEOUT: Duration = Duration::from_secs(60);

fn finish(command: &mut Command) -> Result<()> {
    let output = command.stdin(Stdio::null()).output().with_context(|| line(command))?;
    let message = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    if output.status.success() { Ok(()) } else { Err(anyhow!("{}: {message}", line(command))) }
}

pub(crate) fn remove(dir: &Path) -> std::io::Result<()> {
    if dir.exists() { fs_err::remove_dir_all(dir) } else { Ok(()) }
}

fn flag_value(value: &(impl ValueEnum + Debug)) -> Result<String> {
    let name = value.to_possible_value().map(|value| value.get_name().to_owned());
    name.ok_or_else(|| anyhow!("{value:?} has no name"))
}

impl Service {
    pub(crate) fn get(&self, path: &str) -> Result<Value> {
        let body = agent().get(format!("{}{path}", self.url)).call()?.body_mut().read_to_string()?;
        serde_json::from_str(&body).with_context(|| path.to_owned())
    }

    /// Sends JSON and returns the JSON of the answer, whatever its status.
    pub(crate) fn post(&self, path: &str, body: &Value) -> Result<Value> {
        self.send(path, "application/json", body.to_string().as_bytes())
    }

    pub(crate) fn post_image(&self, path: &str, png: &[u8]) -> Result<Value> {
        self.send(path, "image/png", png)
    }

    fn send(&self, path: &str, media_type: &str, body: &[u8]) -> Result<Value> {
        let request = agent().post(format!("{}{path}", self.url)).content_type(media_type);
        let body = request.send(body)?.body_mut().read_to_string()?;
        serde_json::from_str(&body).with_context(|| path.to_owned())
    }
}

/// A client without a proxy, for which no status is an error.
fn agent() -> ureq::Agent {
    let config = ureq::Agent::config_builder().proxy(None).http_status_as_error(false);
    config.timeout_global(Some(TIMEOUT)).build().into()
}

pub(crate) fn fetch_all(store: &Path, cache: &Path, profile: &str) -> Result<()> {
    remove(cache)?;
    fetch(store, cache, &["--at", "0,0,0", "--radius", "1e6", "--profile", profile]).map(|_| ())
}

/// Generated scenes on robots, of each kind and seed in a folder of its own: `scene`, `store` and `cache`.
pub(crate) struct Prepared<'a> {
    pub(crate) out: &'a Path,
    pub(crate) kinds: &'a [SceneKind],
    pub(crate) seeds: &'a [u64],
    pub(crate) n_views: u32,
    pub(crate) walk: Walk,
    /// Further flags of `encode`; `SCENE` in them stands for the scene's folder.
    pub(crate) encode_flags: &'a [&'a str],
}

impl Prepared<'_> {
    /// Judges each scene by kind, seed and folder; returns the names.
    pub(crate) fn judge(
        &self,
        progress: &dyn Progress,
        mut judge: impl FnMut(SceneKind, u64, &Path) -> Result<()>,
    ) -> Result<Vec<String>> {
        let mut names = Vec::new();
        progress.begin("judge", "scene", (self.kinds.len() * self.seeds.len()) as u64, 0);
        for (kind, seed) in
            self.kinds.iter().flat_map(|kind| self.seeds.iter().map(move |seed| (*kind, *seed)))
        {
            let name = format!("{}-{seed}", flag_value(&kind)?);
            let dir = self.out.join(&name);
            let judged = self.make(kind, seed, &dir).and_then(|()| judge(kind, seed, &dir));
            judged.with_context(|| dir.display().to_string())?;
            names.push(name);
            progress.advance(1);
        }
        progress.end();
        Ok(names)
    }

    fn make(&self, kind: SceneKind, seed: u64, dir: &Path) -> Result<()> {
        let [scene, store, cache] = ["scene", "store", "cache"].map(|name| dir.join(name));
        let (poses, splat) = (scene.join("transforms.json"), scene.join("scene.ply"));
        if !poses.is_file() {
            let (kind, seed, n_views) = (flag_value(&kind)?, seed.to_string(), self.n_views.to_string());
            let mut command = Command::new(sibling("slag-lab")?);
            command.args(["generate", "scene", "--kind", &kind, "--seed", &seed, "--n-views", &n_views]);
            finish(command.args(["--walk", &flag_value(&self.walk)?, "--out"]).arg(&scene))?;
        }
        if !store.join("manifest").is_file() {
            let mut command = Command::new(sibling("slag-encoder")?);
            command.args(["encode", "--metric", "--scene"]).arg(&splat).arg("--views").arg(&poses);
            let folder = scene.to_string_lossy();
            command.args(self.encode_flags.iter().map(|flag| flag.replace("SCENE", &folder)));
            finish(command.arg("--store").arg(&store))?;
        }
        if !cache.join("current").is_file() {
            fetch_all(&store, &cache, "compact")?;
        }
        Ok(())
    }
}
