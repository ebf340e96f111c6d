//! The project's programs, run as a user runs them.

#[cfg(feature = "measure")]
mod prepared;

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, bail};
use serde_json::Value;

#[cfg(feature = "measure")]
pub(crate) use prepared::{Prepared, fetch_all, remove};

pub(crate) fn sibling(name: &str) -> Result<PathBuf> {
    let lab = std::env::current_exe().context("cannot find the path of this program")?;
    let path = lab.with_file_name(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    if path.is_file() { Ok(path) } else { bail!("{} does not exist; build it first", path.display()) }
}

/// Runs a command and parses its JSON. Exit code 3 is no error: some inputs were left out, and the figures count them.
pub(crate) fn json_of(command: &mut Command) -> Result<Value> {
    let output = command.stdin(Stdio::null()).output().with_context(|| line(command))?;
    let printed: Option<Value> = serde_json::from_slice(&output.stdout).ok();
    // `message` from the encoder, `detail` from the robot's program.
    let error = |value: &Value| {
        ["message", "detail"].iter().find_map(|key| Some(value["error"][key].as_str()?.to_owned()))
    };
    match (printed.as_ref().and_then(error), printed, output.status.code()) {
        (None, Some(value), Some(0 | 3)) => Ok(value),
        (Some(message), ..) => bail!("{}: {message}", line(command)),
        _ => bail!("{}: {}", line(command), String::from_utf8_lossy(&output.stderr).trim()),
    }
}

fn line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ")
}

/// A program's `serve` on a free port; stopped when dropped.
pub(crate) struct Service {
    child: Child,
    pub(crate) url: String,
}

impl Service {
    /// `flag`: the one that takes the folder.
    pub(crate) fn start(program: &Path, flag: &str, folder: &Path) -> Result<Self> {
        let mut command = Command::new(program);
        command.args(["--quiet", "serve", "--listen", "127.0.0.1:0", flag]).arg(folder);
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
        let mut service = Self { child: child.with_context(|| line(&command))?, url: String::new() };
        let mut first = String::new();
        if let Some(stdout) = service.child.stdout.take() {
            BufReader::new(stdout).read_line(&mut first)?;
        }
        let url = first.trim().strip_prefix("listening on ");
        service.url =
            url.with_context(|| format!("{}: expected its address, found {first:?}", line(&command)))?.into();
        Ok(service)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Copies parts of a store to a cache, as a robot does; returns the program's JSON.
pub(crate) fn fetch(store: &Path, cache: &Path, flags: &[&str]) -> Result<Value> {
    let service = Service::start(&sibling("slag-encoder")?, "--store", store)?;
    let mut fetch = Command::new(sibling("slag-edge")?);
    fetch.args(["fetch", "--trust-first", "--json", "--quiet", "--from", &service.url]).args(flags);
    json_of(fetch.arg("--cache").arg(cache))
}
