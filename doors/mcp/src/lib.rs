//! A robot's answers as tools of the Model Context Protocol, for language models.
//!
//! The tools query `slag-edge serve` over HTTP and change nothing there.

mod changes;
mod find;
pub mod http;
mod list;
mod locate;
mod place;
mod stand;
pub mod stdio;
mod tools;

use clap::Parser;
use slag_robot::RobotArgs;
use slag_service::listen::Listen;

pub use tools::Tools;

/// Lets language models ask a robot, over the Model Context Protocol: on stdin and stdout, or over HTTP.
#[derive(Debug, Parser)]
#[command(name = "slag-mcp", version, allow_negative_numbers = true)]
pub struct Args {
    /// The robot to ask.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Speak streamable HTTP at /mcp of this address, instead of stdin and stdout.
    #[arg(long, value_name = "IP:PORT|unix:PATH")]
    pub listen: Option<Listen>,
    /// Name that clients call this machine by, besides localhost and the address listened on; other names are
    /// refused. May be repeated.
    #[arg(long, value_name = "NAME", requires = "listen")]
    pub host: Vec<String>,
}
