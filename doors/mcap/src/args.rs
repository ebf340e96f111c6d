//! The command line.

use std::path::PathBuf;

use clap::Parser;
use slag_robot::RobotArgs;

/// Writes a robot's answers and the ground around it to an MCAP file, which Foxglove and its libraries read.
#[derive(Debug, Parser)]
#[command(name = "slag-mcap", version, allow_negative_numbers = true)]
pub struct Args {
    /// The robot to ask.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Text to look for, which may name a relation; may be repeated.
    #[arg(long, required_unless_present = "ground")]
    pub text: Vec<String>,
    /// Most things for a text.
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub limit: u32,
    /// Most Gaussians for a text, best first; 0: none.
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    pub points: u32,
    /// Writes the ground around the robot, too; needs a scene encoded with --occupancy.
    #[arg(long)]
    pub ground: bool,
    /// File to write.
    #[arg(value_name = "FILE")]
    pub out: PathBuf,
}
