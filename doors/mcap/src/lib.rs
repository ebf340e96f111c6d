//! A robot's answers and ground as an MCAP file for Foxglove and the MCAP libraries (docs/api.md).

mod file;
mod messages;

use std::path::PathBuf;
use std::time::SystemTime;

use anyhow::{Context, Result, anyhow};
use clap::Parser;
use serde_json::json;

use file::File;
use messages::Stamp;
use slag_robot::{RobotArgs, durable};

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

/// Queries a robot and writes its answers; returns the number of messages. A refused request leaves no file.
pub fn record(args: &Args) -> Result<usize> {
    let robot = args.robot.open()?;
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let time_ns = since_1970.context("the clock is before 1970")?.as_nanos() as u64;
    let mut messages = Vec::new();
    for text in &args.text {
        let reply = robot.ask(&json!({"texts": [text], "limit": args.limit}))?;
        let stamp = Stamp { time_ns, frame: &reply.frame };
        for found in &reply.results {
            if let Some(none) = &found.none {
                slag_robot::note(format_args!("{text}: {}", none.detail));
            }
            let things = messages::things(stamp, text, &found.answers);
            messages.push((format!("/slag/things/{text}"), file::THINGS, things));
        }
        // A relation is between things; only plain words have matching Gaussians.
        let is_relation = reply.results.iter().any(|found| found.understood.is_some());
        if args.points > 0 && !is_relation {
            let reply = robot.ask_points(&json!({"texts": [text], "limit": args.points}))?;
            let stamp = Stamp { time_ns, frame: &reply.frame };
            for found in &reply.results {
                let points = messages::points(stamp, &found.answers);
                messages.push((format!("/slag/points/{text}"), file::POINTS, points));
            }
        }
    }
    if args.ground {
        let frame = robot.place()?.frame;
        let floor = robot.floor(&[])?;
        let ground = messages::ground(Stamp { time_ns, frame: &frame }, &floor);
        let ground = ground.context("the robot's ground has other cells than it says")?;
        messages.push(("/slag/ground".to_owned(), file::GROUND, ground));
    }
    let written = durable::write_result(&args.out, |out| {
        let mut file = File::new(out, time_ns)?;
        messages.iter().try_for_each(|(topic, schema, message)| file.write(topic, *schema, message))?;
        file.finish()
    });
    let out = args.out.display();
    written.map_err(|error| {
        anyhow!("{out}: {error:#}; give a file in a folder that exists, can be written and has space")
    })?;
    Ok(messages.len())
}
