//! `goal`.

use std::io::Write;
use std::path::PathBuf;

use crate::goal::{self, GoalRequest, GoalTarget, Robot, Stand};
use crate::query::parse_point;
use crate::score::Budget;
use anyhow::anyhow;
use clap::Args;
use glam::DVec3;
use slag_api::goal::{Goal, GoalReply, MissedThing, NoGoal};
use slag_common::objects::parse_public_id;
use slag_common::{durable, files};

use super::args::EngineArgs;
use super::failure::Failure;
use super::output::print_json;
use super::text::{table, visible};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge goal chair\n\
    \x20 slag-edge goal chair --near 1,2,0\n\
    \x20 slag-edge goal chair --near 1,2,0 --map map.pgm\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct GoalArgs {
    /// The thing to go to, in words or by its id (o and 16 hex digits).
    pub thing: String,
    /// Where the robot is, world frame [default: the middle of the area on board].
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    pub near: Option<DVec3>,
    /// Where it looks, for things such as "chair left of me": radians from the world's x axis towards y.
    #[arg(long, value_name = "RAD", allow_negative_numbers = true)]
    pub heading_rad: Option<f64>,
    #[command(flatten)]
    pub robot: Robot,
    #[command(flatten)]
    pub stand: Stand,
    /// Write the ground around the robot as a picture: black what it must not touch, grey what is unknown, white
    /// where it can go.
    #[arg(long, value_name = "FILE.pgm")]
    pub map: Option<PathBuf>,
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Print the poses as JSON.
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: GoalArgs) -> Result<(), Failure> {
    let target =
        parse_public_id(&args.thing).map_or_else(|| GoalTarget::Text(args.thing.clone()), GoalTarget::Object);
    let GoalArgs { near, heading_rad, robot, stand, .. } = args;
    let request = GoalRequest { target, near, heading_rad, robot, stand };
    request.check()?;
    let no_map =
        |error| Failure::failed("map", anyhow!("{error}; give --map a file in a folder that can be written"));
    args.map.iter().try_for_each(|path| files::check_writable(path)).map_err(no_map)?;
    let engine = args.engine.open()?;
    let on_board = engine.on_board()?;
    if let Some(path) = &args.map {
        let map = goal::floor_map(&on_board.snapshot, &request, &Budget::default())?;
        durable::write_result(path, |file| map.write_pgm(file))?;
    }
    let reply = goal::find(&on_board, &request, &Budget::default())?;
    if args.json {
        return print_json(&reply);
    }
    Ok(std::io::stdout().write_all(lines(&reply).as_bytes())?)
}

fn lines(reply: &GoalReply) -> String {
    let mut text = String::new();
    if reply.thing.is_some() {
        for MissedThing { thing, none } in &reply.missed {
            let [x, y, z] = thing.position_in_world.to_array();
            let why = match none {
                NoGoal::NoSuchThing => "is not on board",
                NoGoal::Unreachable => "no way leads there",
                NoGoal::UnknownGround => "the ground around it is not known",
                NoGoal::NotVisible => "it is not seen from any place to stand",
            };
            text += &format!("{} at {x:.2}, {y:.2}, {z:.2} matches better, but {why}\n", thing.id);
        }
    }
    if let Some(thing) = &reply.thing {
        let [x, y, z] = thing.position_in_world.to_array();
        text.push_str(&format!("{} at {x:.2}, {y:.2}, {z:.2}\n", thing.id));
        let row = |goal: &Goal| {
            let [x, y, z] = goal.position_in_world.to_array();
            let lengths = [x, y, z, goal.yaw_rad, goal.clearance_m, goal.path_m, goal.distance_m];
            let mut row: Vec<String> = lengths.iter().map(|length| format!("{length:.2}")).collect();
            row.push(format!("{:.0} %", 100.0 * goal.visible_share));
            row
        };
        let rows: Vec<Vec<String>> = reply.goals.iter().map(row).collect();
        let head = ["x", "y", "z", "yaw", "clearance m", "way m", "distance m", "visible"];
        text.push_str(&table(&head, &rows));
    }
    if let Some(none) = &reply.none {
        text.push_str(&format!("no place to stand: {}\n", visible(&none.detail)));
    }
    text
}
