//! A generated scene on a robot, and the robot's own program, asked over HTTP.

use std::fmt::Debug;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use clap::ValueEnum;
use serde_json::Value;

use crate::generate::compose::Walk;

/// Longest wait for an answer.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A running service, which is stopped when dropped.
pub struct Service {
    child: Child,
    address: String,
}

impl Service {
    /// Starts a program's `serve` on a free port.
    pub fn start(program: &Path, flags: &[&str], folder: &Path) -> Result<Self> {
        let mut command = Command::new(program);
        command.args(["--quiet", "serve", "--listen", "127.0.0.1:0"]).args(flags).arg(folder);
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
        let mut child = child.with_context(|| format!("cannot start {}", program.display()))?;
        let mut line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut line)?;
        }
        let address = line.trim().strip_prefix("listening on http://").map(str::to_owned);
        let mut service = Self { child, address: String::new() };
        service.address =
            address.ok_or_else(|| anyhow!("{}: expected its address, found {line:?}", program.display()))?;
        Ok(service)
    }

    /// Returns its URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Returns the JSON of a resource, whatever its status.
    pub fn get(&self, path: &str) -> Result<Value> {
        self.exchange(
            path,
            &format!("GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", self.address),
        )
    }

    /// Sends JSON and returns the JSON of the answer, whatever its status.
    pub fn post(&self, path: &str, body: &Value) -> Result<Value> {
        let (address, body) = (&self.address, body.to_string());
        let request = format!(
            "POST {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        );
        self.exchange(path, &request)
    }

    fn exchange(&self, path: &str, request: &str) -> Result<Value> {
        let mut stream = TcpStream::connect(&self.address)?;
        stream.set_read_timeout(Some(TIMEOUT))?;
        stream.write_all(request.as_bytes())?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer)?;
        let head = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n");
        let head = head.ok_or_else(|| anyhow!("{path}: the answer is no HTTP"))?;
        serde_json::from_slice(&answer[head + 4..]).with_context(|| format!("{path}: the answer is no JSON"))
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns a value as flags take it.
pub fn flag_value(value: &(impl ValueEnum + Debug)) -> Result<String> {
    let name = value.to_possible_value().map(|value| value.get_name().to_owned());
    name.ok_or_else(|| anyhow!("{value:?} has no name"))
}

/// A generated scene on a robot, in a folder: `scene`, `store` and `cache`.
pub struct Prepared<'a> {
    /// Folder of the programs.
    pub programs: &'a Path,
    /// The folder.
    pub dir: &'a Path,
    /// Kind of scene, as `generate scene` names it.
    pub kind: &'a str,
    /// Its seed.
    pub seed: u64,
    /// Its photos.
    pub n_views: u32,
    /// Where they are taken.
    pub walk: Walk,
    /// Further flags of `encode`; `SCENE` in them stands for the scene's folder.
    pub encode_flags: &'a [&'a str],
}

impl Prepared<'_> {
    /// Returns the path of one of the programs.
    pub fn program(&self, name: &str) -> PathBuf {
        self.programs.join(format!("{name}{}", std::env::consts::EXE_SUFFIX))
    }

    /// Generates, encodes and fetches the scene, as far as that was not done before.
    pub fn make(&self) -> Result<()> {
        let [scene, store, cache] = ["scene", "store", "cache"].map(|name| self.dir.join(name));
        let (poses, splat) = (scene.join("transforms.json"), scene.join("scene.ply"));
        if !poses.is_file() {
            let (seed, n_views) = (self.seed.to_string(), self.n_views.to_string());
            let mut command = Command::new(self.program("slag-lab"));
            command.args([
                "generate",
                "scene",
                "--kind",
                self.kind,
                "--seed",
                &seed,
                "--n-views",
                &n_views,
                "--walk",
                &flag_value(&self.walk)?,
                "--out",
            ]);
            finish(command.arg(&scene))?;
        }
        if !store.join("manifest").is_file() {
            let mut command = Command::new(self.program("slag-encoder"));
            command.args(["encode", "--metric", "--scene"]).arg(&splat).arg("--views").arg(&poses);
            let folder = scene.to_string_lossy();
            command.args(self.encode_flags.iter().map(|flag| flag.replace("SCENE", &folder)));
            finish(command.arg("--store").arg(&store))?;
        }
        if !cache.join("current").is_file() {
            let server = Service::start(&self.program("slag-encoder"), &["--store"], &store)?;
            let mut command = Command::new(self.program("slag-edge"));
            command.args(["fetch", "--trust-first", "--at", "0,0,0", "--radius", "1e6"]);
            finish(command.args(["--from", &server.url(), "--cache"]).arg(&cache))?;
        }
        Ok(())
    }
}

fn finish(command: &mut Command) -> Result<()> {
    let output =
        command.stdin(Stdio::null()).output().with_context(|| format!("cannot start {command:?}"))?;
    if output.status.success() {
        return Ok(());
    }
    Err(anyhow!("{command:?}: {}", String::from_utf8_lossy(&output.stderr).trim()))
}
