//! Runs the project's programs as a user does.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use serde_json::Value;
use slag_common::shard::Profile;

/// A program that failed.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// It could not be started, or a file could not be changed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// It ended with an error.
    #[error("{command}: {message}")]
    Failed {
        /// Its command line.
        command: String,
        /// Its error message.
        message: String,
    },
}

/// Runs a command and parses the JSON it prints.
///
/// # Errors
/// [`ProgramError`].
pub fn json_of(command: &mut Command) -> Result<Value, ProgramError> {
    let output = command.stdin(Stdio::null()).output()?;
    let printed: Option<Value> = serde_json::from_slice(&output.stdout).ok();
    // The encoder says `message`, the robot's program `detail`.
    let error = |value: &Value| {
        ["message", "detail"].iter().find_map(|key| Some(value["error"][key].as_str()?.to_owned()))
    };
    let message = printed.as_ref().and_then(error);
    // Exit code 3: some inputs were left out; the figures count them.
    match (printed.as_ref(), message, output.status.code()) {
        (Some(value), None, Some(0 | 3)) => Ok(value.clone()),
        (_, Some(message), _) => Err(failed(command, message)),
        _ => Err(failed(command, String::from_utf8_lossy(&output.stderr).trim().to_owned())),
    }
}

fn failed(command: &Command, message: String) -> ProgramError {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    let command = words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ");
    ProgramError::Failed { command, message }
}

/// A store's service on loopback, which is stopped when dropped.
pub struct Server {
    child: Child,
    /// Its address.
    pub url: String,
}

impl Server {
    /// Starts a store's service with `slag-encoder`.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn start(encoder: &Path, store: &Path) -> Result<Self, ProgramError> {
        let mut command = Command::new(encoder);
        command.args(["--quiet", "serve", "--listen", "127.0.0.1:0", "--store"]).arg(store);
        let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn()?;
        let mut server = Self { child, url: String::new() };
        let mut line = String::new();
        if let Some(stdout) = server.child.stdout.take() {
            BufReader::new(stdout).read_line(&mut line)?;
        }
        match line.trim().strip_prefix("listening on ") {
            Some(url) => server.url = url.to_owned(),
            None => return Err(failed(&command, format!("expected its address, found {line:?}"))),
        }
        Ok(server)
    }

    /// Copies a whole store to an empty cache with `slag-edge`.
    ///
    /// # Errors
    /// [`ProgramError`].
    pub fn fetch_all(&self, edge: &Path, cache: &Path, profile: Profile) -> Result<(), ProgramError> {
        remove(cache)?;
        let mut fetch = Command::new(edge);
        fetch.args([
            "fetch",
            "--trust-first",
            "--json",
            "--quiet",
            "--at",
            "0,0,0",
            "--radius",
            "1e6",
            "--from",
            &self.url,
        ]);
        json_of(fetch.args(["--profile", profile.name(), "--cache"]).arg(cache)).map(|_| ())
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Removes a folder where it exists.
///
/// # Errors
/// The file system's.
pub fn remove(dir: &Path) -> std::io::Result<()> {
    if dir.exists() { fs_err::remove_dir_all(dir) } else { Ok(()) }
}

/// Returns the load average of the last minute (Linux).
pub fn load_1min() -> Option<f64> {
    let load = fs_err::read_to_string("/proc/loadavg").ok()?;
    load.split(' ').next()?.parse().ok()
}
