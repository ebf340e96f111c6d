//! Flags of every door that select the robot.

use std::io;
use std::path::PathBuf;

use clap::Args;
use slag_common::files;
use ureq::http::Uri;

use crate::client::Robot;

/// More than any token that a robot accepts.
const MAX_TOKEN_BYTES: u64 = 8192;

/// The robot to ask.
#[derive(Clone, Debug, Args)]
pub struct RobotArgs {
    /// Address of the robot's `slag-edge serve`.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7734", env = "SLAG_ROBOT", value_parser = address)]
    robot: String,
    /// File with the token of the robot's --token-file.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
}

fn address(text: &str) -> Result<String, &'static str> {
    let url = text.parse::<Uri>().ok().filter(|url| matches!(url.scheme_str(), Some("http" | "https")));
    url.and_then(|url| url.host().map(|_| text.to_owned()))
        .ok_or("expected http://HOST:PORT or https://HOST:PORT")
}

impl RobotArgs {
    /// Returns the robot, with the file's token; sends nothing.
    pub fn open(&self) -> io::Result<Robot> {
        let read = |path: &PathBuf| io::read_to_string(&files::read_short(path, MAX_TOKEN_BYTES)?[..]);
        let token = self.token_file.as_ref().map(read).transpose()?;
        Ok(Robot::new(&self.robot, token.as_deref().map(str::trim)))
    }
}
