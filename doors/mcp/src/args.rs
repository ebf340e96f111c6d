//! The command line.

use std::path::PathBuf;

use clap::Parser;
use slag_service::listen::Listen;

/// Lets language models ask a robot, over the Model Context Protocol: on stdin and stdout, or over HTTP.
#[derive(Debug, Parser)]
#[command(name = "slag-mcp", version)]
pub struct Args {
    /// Address of the robot's `slag-edge serve`.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7734", env = "SLAG_ROBOT")]
    pub robot: String,
    /// File with the token of the robot's --token-file.
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Speak streamable HTTP at /mcp of this address, instead of stdin and stdout.
    #[arg(long, value_name = "IP:PORT|unix:PATH")]
    pub listen: Option<Listen>,
    /// Name that clients call this machine by, besides localhost and the address listened on; other names are refused.
    /// May be repeated.
    #[arg(long, value_name = "NAME", requires = "listen")]
    pub host: Vec<String>,
}
