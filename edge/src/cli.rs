//! The command line: what can be asked for, and how a run ends.

mod bench;
mod commands;
mod fetch;
mod output;

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use glam::DVec3;
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::shard::Profile;
use slag_edge::query::{AnswerKind, DEFAULT_MIN_COUNT, Negatives, parse_box, parse_point};
use slag_edge::score::Precision;
use slag_models::commands::{ModelsCommand, RunArgs};

/// Keeps the shards around a robot and answers text queries offline.
#[derive(Debug, Parser)]
#[command(name = "slag-edge", version)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log more (twice: all).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    /// Log errors only, show no progress.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Brings the shards around a position on board.
    Fetch(FetchArgs),
    /// Answers questions over HTTP, from what is on board.
    Serve(ServeArgs),
    /// Answers one question from what is on board.
    Query(QueryArgs),
    /// Shows what is on board.
    Status(StatusArgs),
    /// Public text models: what is known, pulling, checking, showing.
    Models(ModelsArgs),
    /// Measures a service and this machine; prints JSON.
    #[command(subcommand)]
    Bench(BenchCommand),
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    /// Times questions to what is on board, without text model and HTTP.
    Query(bench::BenchQueryArgs),
    /// The longest time a query waits while fetches replace the generation.
    Pause(PauseArgs),
    /// How a service stands more queries than it can answer.
    Load(LoadArgs),
    /// Times the text model.
    Text(bench::BenchTextArgs),
}

#[derive(Debug, Args)]
struct PauseArgs {
    /// Gaussians of the generated scene.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1000..=16_000_000))]
    gaussians: u32,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=8192))]
    dim: u32,
    /// Generations that are fetched, one after the other.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=1000))]
    fetches: u32,
    /// Folder to work in [default: a new one among the system's temporary files].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct LoadArgs {
    /// The service, as `slag-edge serve` prints it.
    #[arg(long, value_name = "URL")]
    url: String,
    /// What is asked for.
    #[arg(long, default_value = "red")]
    text: String,
    /// Questions a second, as a multiple of what the service answers.
    #[arg(long, value_name = "X", default_value_t = 10.0)]
    overload: f64,
    /// Questions at a time, at most.
    #[arg(long, value_name = "N", default_value_t = 320, value_parser = clap::value_parser!(u32).range(1..=4096))]
    clients: u32,
    /// How long.
    #[arg(long, value_name = "S", default_value_t = 600)]
    seconds: u64,
    /// Process whose memory is watched (Linux).
    #[arg(long, value_name = "PID")]
    pid: Option<u32>,
}

#[derive(Debug, Args)]
struct CacheArgs {
    /// Folder of what is on board [default: $XDG_CACHE_HOME/slag, else ~/.cache/slag].
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct ThreadArgs {
    /// Threads that questions are worked on with [default: as many as there are cores].
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,
}

#[derive(Debug, Args)]
struct ModelArgs {
    /// Folder of the text model, with its model.toml, or name of a pulled model (`models list`) [default: the
    /// built-in stand-in].
    #[arg(long, visible_alias = "encoder", value_name = "NAME|DIR")]
    models: Option<PathBuf>,
    #[command(flatten)]
    how: RunArgs,
}

#[derive(Debug, Args)]
struct FetchArgs {
    /// Address of the store [default: that of the last fetch].
    #[arg(long, value_name = "URL")]
    from: Option<String>,
    /// Where the robot is, world frame [default: where it was at the last fetch].
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    at: Option<DVec3>,
    /// Where the robot is: WGS 84 degrees, and metres.
    #[arg(long, value_name = "LAT,LON[,HEIGHT]", value_parser = parse_geographic, allow_hyphen_values = true, conflicts_with = "at")]
    at_geo: Option<(f64, f64, Option<f64>)>,
    /// How far around, world units (metres where the scene is metric).
    #[arg(long, default_value_t = 50.0)]
    radius: f64,
    /// How much each shard carries: compact or exact.
    #[arg(long, default_value_t = Profile::Compact)]
    profile: Profile,
    /// The only public key accepted, or the one that took its place; given again: its successor, for a
    /// robot that missed the change [default: the one accepted before, or the first one met].
    #[arg(long, value_name = "HEX")]
    key: Vec<Hash32>,
    /// Bytes that shards may take [default: twice what the radius needs].
    #[arg(long, value_name = "N")]
    max_bytes: Option<u64>,
    /// Follow the robot: read positions from stdin, one a line, `x y z` or `lat,lon[,height]`, or as
    /// JSON, and fetch whenever it needs more.
    #[arg(long)]
    watch: bool,
    #[command(flatten)]
    follow: FollowArgs,
    #[command(flatten)]
    cache: CacheArgs,
    /// Print the report as JSON (with --watch: one a line).
    #[arg(long)]
    json: bool,
}

/// How a robot is followed.
#[derive(Debug, Args)]
struct FollowArgs {
    /// When following: how much farther than the radius is fetched, world units [default: a quarter of
    /// the radius].
    #[arg(long, value_name = "D")]
    margin: Option<f64>,
    /// When following: seconds between fetches, at least.
    #[arg(long, value_name = "S", default_value_t = 2)]
    min_interval_secs: u64,
    /// When following: seconds after which a robot that stays looks for a new generation; 0: never.
    #[arg(long, value_name = "S", default_value_t = 300)]
    refresh_secs: u64,
}

#[derive(Debug, Args)]
struct ServeArgs {
    /// Address to listen on.
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:7734")]
    listen: SocketAddr,
    /// Follow the robot: fetch from this store around the positions that POST /position says.
    #[arg(long, value_name = "URL")]
    follow: Option<String>,
    /// When following: how far around the robot cells are kept, world units.
    #[arg(long, default_value_t = 50.0)]
    radius: f64,
    /// When following: how much each shard carries: compact or exact.
    #[arg(long, default_value_t = Profile::Compact)]
    profile: Profile,
    /// When following: the only public keys accepted, at most two.
    #[arg(long, value_name = "HEX")]
    key: Vec<Hash32>,
    /// When following: bytes that shards may take [default: twice what the radius needs].
    #[arg(long, value_name = "N")]
    max_bytes: Option<u64>,
    #[command(flatten)]
    following: FollowArgs,
    #[command(flatten)]
    threads: ThreadArgs,
    #[command(flatten)]
    cache: CacheArgs,
    #[command(flatten)]
    models: ModelArgs,
}

#[derive(Debug, Args)]
struct QueryArgs {
    /// What to look for.
    text: String,
    /// What it is told from: none, canonical (object, things, stuff, texture), or phrases A,B,C.
    #[arg(long, default_value = "none")]
    negatives: Negatives,
    /// Where the asker is, world frame: answers carry their distance and nearer ones rank higher.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    near: Option<DVec3>,
    /// Only within this distance of --near, world units.
    #[arg(long, requires = "near")]
    radius: Option<f64>,
    /// Only between two corners of a box, world frame.
    #[arg(long = "box", value_name = "X,Y,Z,X,Y,Z", value_parser = parse_box, allow_hyphen_values = true)]
    bounds: Option<Aabb>,
    /// Most answers [default: 10].
    #[arg(long)]
    limit: Option<usize>,
    /// Cosine, or relevancy with negatives, from which a Gaussian matches [default: the scene's; 0.5].
    #[arg(long, allow_hyphen_values = true)]
    threshold: Option<f32>,
    /// What answers are made of: objects, clusters or gaussians [default: objects where the scene has them, else
    /// clusters].
    #[arg(long)]
    kind: Option<AnswerKind>,
    /// Edge of the voxels that join Gaussians to clusters, world units [default: 0.25 m, or the scene's].
    #[arg(long)]
    voxel: Option<f64>,
    /// Clusters with fewer Gaussians are dropped, and counted.
    #[arg(long, default_value_t = DEFAULT_MIN_COUNT)]
    min_count: u64,
    /// Which data scores come from: rows, measured (embeddings only where the measured errors of their codes do
    /// not decide) or exact.
    #[arg(long, value_name = "NAME", default_value_t = Precision::Exact)]
    precision: Precision,
    #[command(flatten)]
    threads: ThreadArgs,
    #[command(flatten)]
    cache: CacheArgs,
    #[command(flatten)]
    models: ModelArgs,
    /// Print the answers as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct StatusArgs {
    #[command(flatten)]
    cache: CacheArgs,
    /// Print the status as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct ModelsArgs {
    #[command(subcommand)]
    command: ModelsCommand,
    /// Print the result as JSON.
    #[arg(long, global = true)]
    json: bool,
}

/// How a run ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done, even if nothing was found.
    Done = 0,
    /// Failed.
    Failed = 1,
    /// Asked for something that cannot be; clap exits with it too.
    Usage = 2,
    /// Interrupted by a signal (128 + SIGINT).
    Interrupted = 130,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

impl Cli {
    /// Returns what is logged unless `RUST_LOG` says otherwise.
    pub fn log_filter(&self) -> &'static str {
        match (self.quiet, self.verbose, &self.command) {
            (true, ..) => "error",
            (_, 0, Command::Serve(_)) | (_, 1, _) => "warn,slag_edge=info",
            (_, 0, Command::Models(_)) => "warn,slag_models=info",
            (_, 0, _) => "warn",
            _ => "debug",
        }
    }

    /// Runs the command and reports how it went.
    pub fn run(self) -> Exit {
        let (json, result) = match self.command {
            Command::Fetch(args) => (args.json, fetch::fetch(args, self.quiet)),
            Command::Serve(args) => (false, commands::serve(args)),
            Command::Query(args) => (args.json, commands::query(args)),
            Command::Status(args) => (args.json, commands::status(args)),
            Command::Models(args) => (args.json, commands::models(args)),
            Command::Bench(command) => (true, bench::run(command)),
        };
        match result {
            Ok(()) => Exit::Done,
            Err(failure) => failure.report(json),
        }
    }
}

fn parse_geographic(text: &str) -> Result<(f64, f64, Option<f64>), String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    let in_range = |lat: f64, lon: f64| lat.abs() <= 90.0 && lon.abs() <= 180.0;
    match numbers.as_deref() {
        Some([lat, lon]) if in_range(*lat, *lon) => Ok((*lat, *lon, None)),
        Some([lat, lon, height]) if in_range(*lat, *lon) && height.is_finite() => {
            Ok((*lat, *lon, Some(*height)))
        }
        _ => Err("degrees LAT,LON within ±90 and ±180, optionally a height in metres".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(line.split(' '))
    }

    #[test]
    fn the_definition_is_sound() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }

    #[test]
    fn lines_parse() {
        let Command::Fetch(fetch) =
            parse("slag-edge fetch --from http://a:1 --at -1,2.5,-3e1 --watch --margin 4 --radius 20 --profile exact --max-bytes 7 --cache c --json")
                .expect("parses")
                .command
        else {
            panic!("fetch")
        };
        assert_eq!(
            (fetch.at, fetch.radius, fetch.profile),
            (Some(DVec3::new(-1.0, 2.5, -30.0)), 20.0, Profile::Exact)
        );
        assert_eq!((fetch.max_bytes, fetch.cache.cache, fetch.json), (Some(7), Some("c".into()), true));
        let Command::Fetch(fetch) = parse("slag-edge fetch --at-geo -46.8,-92").expect("parses").command
        else {
            panic!("fetch")
        };
        assert_eq!(
            (fetch.at_geo, fetch.radius, fetch.profile),
            (Some((-46.8, -92.0, None)), 50.0, Profile::Compact)
        );
        assert!(parse("slag-edge bench pause --gaussians 5000").is_ok());
        assert!(parse("slag-edge bench load --url http://a:1 --clients 8 --seconds 2").is_ok());
        let Command::Serve(serve) = parse("slag-edge serve").expect("parses").command else {
            panic!("serve")
        };
        assert_eq!(serve.listen, SocketAddr::from(([127, 0, 0, 1], 7734)));
        let Command::Query(query) = parse(
            "slag-edge query chair --near 1,2,-3 --radius 4 --limit 5 --threshold -0.5 --kind gaussians",
        )
        .expect("parses")
        .command
        else {
            panic!("query")
        };
        assert_eq!((query.text.as_str(), query.near), ("chair", Some(DVec3::new(1.0, 2.0, -3.0))));
        assert_eq!((query.radius, query.limit, query.threshold), (Some(4.0), Some(5), Some(-0.5)));
        assert_eq!(query.kind, Some(AnswerKind::Gaussians));
        let Command::Query(query) =
            parse("slag-edge query chair --box -1,2,3,4,-5,6 --negatives wall,floor --precision centroids")
                .expect("parses")
                .command
        else {
            panic!("query")
        };
        let bounds = Aabb { min: DVec3::new(-1.0, -5.0, 3.0), max: DVec3::new(4.0, 2.0, 6.0) };
        assert_eq!((query.bounds, query.precision), (Some(bounds), Precision::Centroids));
        assert_eq!(query.negatives, Negatives::Phrases(vec!["wall".into(), "floor".into()]));
        assert!(parse("slag-edge status --json --cache d").is_ok());
        assert!(parse("slag-edge models pull clip --accept-licence --json").is_ok());
        assert!(
            parse("slag-edge bench text --encoder clip --provider tensorrt,cuda,cpu --model-threads 2")
                .is_ok()
        );
        assert!(parse("slag-edge bench query --cache d --limits 10,20 --runs 3 --threads 1").is_ok());
    }

    #[test]
    fn wrong_lines_are_refused() {
        for line in [
            "slag-edge",
            "slag-edge query",
            "slag-edge query chair --radius 4",
            "slag-edge query chair --near 1,2",
            "slag-edge query chair --near NaN,0,0",
            "slag-edge query chair --kind points",
            "slag-edge query chair --limit -1",
            "slag-edge query chair --box 1,2,3",
            "slag-edge query chair --negatives ,",
            "slag-edge fetch --at 1,2,3 --at-geo 1,2",
            "slag-edge fetch --at-geo 91,0",
            "slag-edge fetch --key 12",
            "slag-edge fetch --margin",
            "slag-edge bench",
            "slag-edge bench pause --gaussians 1",
            "slag-edge fetch --profile tiny",
            "slag-edge serve --listen nowhere",
            "slag-edge status --quiet --verbose",
            "slag-edge serve --threads 0",
            "slag-edge bench query --runs 0",
            "slag-edge query chair --provider gpu",
            "slag-edge models",
            "slag-edge models pull",
        ] {
            assert_eq!(parse(line).expect_err(line).exit_code(), Exit::Usage as i32, "{line}");
        }
    }
}
