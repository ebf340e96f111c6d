//! The robot's own program, asked over HTTP.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use serde_json::Value;

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

    /// Sends JSON and returns the JSON of the answer, whatever its status.
    pub fn post(&self, path: &str, body: &Value) -> Result<Value> {
        let mut stream = TcpStream::connect(&self.address)?;
        stream.set_read_timeout(Some(TIMEOUT))?;
        let (address, body) = (&self.address, body.to_string());
        write!(
            stream,
            "POST {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\nContent-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        )?;
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
