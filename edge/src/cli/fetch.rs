//! `fetch`.

use std::io::{self, IsTerminal};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::fetch::{FetchRequest, Position, fetch};
use crate::query::parse_point;
use anyhow::anyhow;
use clap::Args;
use glam::DVec3;
use slag_service::stop::on_stop;

use super::args::{CacheArgs, DownloadArgs, parse_store};
use super::failure::{Exit, Failure};
use super::follow::{FollowArgs, watch};
use super::output::print_json;
use super::progress::{Bar, bad_cells, environment, print_report};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge fetch --from http://BASE:7733 --at 12.5,-3,0 --radius 50\n\
    \x20 slag-edge fetch --from http://BASE:7733 --at-geo 46.842657,-91.994008\n\
    \x20 slag-edge fetch\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct FetchArgs {
    /// Address of the store [default: that of the last fetch].
    #[arg(long, value_name = "URL", value_parser = parse_store)]
    pub from: Option<String>,
    /// Position of the robot, world frame [default: that of the last fetch].
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    pub at: Option<DVec3>,
    /// Position of the robot: WGS 84 degrees, and metres.
    #[arg(long, value_name = "LAT,LON[,HEIGHT]", value_parser = parse_geographic, allow_hyphen_values = true, conflicts_with = "at")]
    pub at_geo: Option<Position>,
    /// Change the robot's scene: accept this scene only, from now on. Without it, a store that offers another
    /// scene than the first one fetched is refused.
    #[arg(long, value_name = "NAME")]
    pub scene: Option<String>,
    #[command(flatten)]
    pub download: DownloadArgs,
    /// Follow the robot: read positions from stdin, one a line, as `x y z`, `lat,lon[,height]` or JSON, and
    /// fetch when necessary.
    #[arg(long)]
    pub watch: bool,
    #[command(flatten)]
    pub follow: FollowArgs,
    #[command(flatten)]
    pub cache: CacheArgs,
    /// Print the report as JSON (with --watch: one per line).
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: FetchArgs, quiet: bool) -> Result<(), Failure> {
    let at = args.at.map(Position::World).or(args.at_geo);
    let settings = args.follow.settings(args.download.radius);
    let ca = args.download.ca.clone();
    let request = FetchRequest { scene: args.scene, ..args.download.request(args.from, at) };
    let cache = args.cache.open()?;
    let cancel = Arc::new(AtomicBool::new(false));
    let on_signal = Arc::clone(&cancel);
    on_stop(move || on_signal.store(true, Ordering::Relaxed)).map_err(|e| Failure::failed("signals", e))?;
    let bar = Bar::new(!quiet && !args.json && io::stderr().is_terminal());
    if args.watch {
        return watch(&cache, &request, ca.as_deref(), settings, &cancel, &bar, args.json);
    }
    let result = fetch(&cache, &request, &environment(ca.as_deref(), &cancel, &bar));
    bar.finish();
    let report = result?;
    if args.json { print_json(&report) } else { print_report(&report) }?;
    match bad_cells(&report) {
        Some(what) => Err(Failure::new(Exit::Partial, "fetch", anyhow!(what))),
        None => Ok(()),
    }
}

fn parse_geographic(text: &str) -> Result<Position, &'static str> {
    let position =
        text.parse::<Position>().ok().filter(|position| matches!(position, Position::Geographic { .. }));
    position.ok_or("degrees LAT,LON within ±90 and ±180, optionally a height in metres, at most 1e9")
}
