//! The command line: commands, flags and logging.

mod args;
mod changes;
mod config;
mod doctor;
mod failure;
mod fetch;
mod follow;
mod goal;
mod list;
mod locate;
mod models;
mod output;
mod progress;
mod query;
mod serve;
mod status;
mod text;
mod trust;

use std::ffi::OsString;
use std::io::{self, Write};

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use slag_models::help;

use changes::ChangesArgs;
use config::ConfigError;
use doctor::DoctorArgs;
pub use failure::Exit;
use failure::Failure;
use fetch::FetchArgs;
use goal::GoalArgs;
use list::ListArgs;
use locate::LocateArgs;
use models::ModelsArgs;
use query::QueryArgs;
use serve::ServeArgs;
use status::StatusArgs;
use trust::TrustCommand;

/// Keeps the shards around a robot and answers text queries offline.
#[derive(Debug, Parser)]
#[command(name = "slag-edge", version, after_help = config::HELP)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Log more (twice: everything).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    verbose: u8,
    /// Log errors only, and show no progress.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
    /// File of flags that the command line does not give [default: /etc/slag/edge.toml if it is there].
    /// An empty name: no file.
    #[arg(long, global = true, value_name = "FILE")]
    config: Option<OsString>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Fetch the shards around a position.
    Fetch(FetchArgs),
    /// Answer questions over HTTP from the shards on board.
    Serve(ServeArgs),
    /// Answer one question from the shards on board.
    Query(QueryArgs),
    /// List the things on board and what they are called.
    List(ListArgs),
    /// Find places to stand near a thing: reached, clear, and in sight of it.
    Goal(GoalArgs),
    /// Find the camera of a photo by the landmarks on board.
    Locate(LocateArgs),
    /// Show what changed between two generations that this robot has had.
    Changes(ChangesArgs),
    /// Show what is on board.
    Status(StatusArgs),
    /// Find out whether this robot can answer, and what is missing.
    Doctor(DoctorArgs),
    /// Whom this robot believes.
    #[command(subcommand)]
    Trust(TrustCommand),
    /// List, pull, verify and describe public text models.
    Models(ModelsArgs),
    /// Print completions for a shell.
    Completions {
        #[arg(value_enum)]
        shell: clap_complete::Shell,
    },
}

pub fn parse() -> Result<Cli, Exit> {
    let line: Vec<OsString> = std::env::args_os().collect();
    let parsed = config::parse(help::layered(Cli::command()), &line, &args::variable);
    match parsed.and_then(|matches| Ok(Cli::from_arg_matches(&matches)?)) {
        Ok(cli) => {
            let names = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
            for warning in config::unknown_variables(&Cli::command(), names) {
                if !cli.quiet {
                    // The log is not open yet, so an unreadable stderr is ignored.
                    let _ = writeln!(io::stderr(), "warning: {}", text::visible(&warning));
                }
            }
            Ok(cli)
        }
        Err(ConfigError::Line(error)) => error.exit(),
        Err(error) => Err(Failure::usage(error).report(false)),
    }
}

impl Cli {
    pub fn log_filter(&self) -> &'static str {
        match (self.quiet, self.verbose, &self.command) {
            (true, ..) => "error",
            (_, 0, Command::Serve(_)) | (_, 1, _) => "warn,slag_edge=info,slag_service=info",
            (_, 0, Command::Models(_)) => "warn,slag_models=info",
            (_, 0, _) => "warn",
            _ => "debug",
        }
    }

    pub fn run(self) -> Exit {
        let (json, result) = match self.command {
            Command::Fetch(args) => (args.json, fetch::run(args, self.quiet)),
            Command::Serve(args) => (false, serve::run(args)),
            Command::Query(args) => (args.json, query::run(args)),
            Command::List(args) => (args.json, list::run(args)),
            Command::Goal(args) => (args.json, goal::run(args)),
            Command::Locate(args) => (args.json, locate::run(args)),
            Command::Changes(args) => (args.json, changes::run(args)),
            Command::Status(args) => (args.json, status::run(args)),
            Command::Doctor(args) => (args.json, doctor::run(args)),
            Command::Trust(command) => (command.is_json(), trust::run(command)),
            Command::Models(args) => (args.json, models::run(args)),
            Command::Completions { shell } => {
                let mut text = Vec::new();
                clap_complete::generate(shell, &mut help::layered(Self::command()), "slag-edge", &mut text);
                (false, io::stdout().write_all(&text).map_err(Into::into))
            }
        };
        match result {
            Ok(()) => Exit::Done,
            Err(failure) => failure.report(json),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::query::{AnswerKind, ListFormat, Negatives, ObjectOrder};
    use crate::score::Precision;
    use glam::DVec3;
    use slag_common::frames::Aabb;
    use slag_common::shard::Profile;

    use super::*;

    fn parse(line: &str) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(line.split(' '))
    }

    #[test]
    fn the_definition_is_sound() {
        Cli::command().debug_assert();
    }

    /// The documents' tests parse the documented lines; these are values with a special meaning.
    #[test]
    fn lines_parse() {
        let command = |line: &str| parse(line).unwrap_or_else(|e| panic!("{line}: {e}")).command;
        let line = "slag-edge fetch --at -1,2.5,-3e1 --radius 20 --profile exact --max-bytes 7 --cache c";
        let Command::Fetch(fetch) = command(line) else { panic!("fetch") };
        assert_eq!(fetch.at, Some(DVec3::new(-1.0, 2.5, -30.0)));
        let download = fetch.download;
        assert_eq!((download.radius, download.profile, download.max_bytes), (20.0, Profile::Exact, Some(7)));
        let Command::Fetch(fetch) = command("slag-edge fetch --at-geo -46.8,-92") else { panic!("fetch") };
        assert_eq!(fetch.at_geo, "-46.8,-92".parse().ok());
        assert_eq!((fetch.download.radius, fetch.download.profile), (50.0, Profile::Compact));
        let Command::Serve(serve) = command("slag-edge serve") else { panic!("serve") };
        assert_eq!(serve.listen.to_string(), "127.0.0.1:7734");
        let line = "slag-edge query chair --near 1,2,-3 --radius 4 --threshold -0.5 --kind gaussians \
                    --box -1,2,3,4,-5,6 --negatives wall,floor --precision centroids";
        let Command::Query(query) = command(line) else { panic!("query") };
        assert_eq!((query.near, query.threshold), (Some(DVec3::new(1.0, 2.0, -3.0)), Some(-0.5)));
        let bounds = Aabb { min: DVec3::new(-1.0, -5.0, 3.0), max: DVec3::new(4.0, 2.0, 6.0) };
        assert_eq!((query.bounds, query.precision), (Some(bounds), Precision::Centroids));
        assert_eq!(query.kind, Some(AnswerKind::Gaussians));
        assert_eq!(query.negatives, Negatives(vec!["wall".into(), "floor".into()]));
        let Command::Goal(goal) = command("slag-edge goal chair --near 1,-2,0") else { panic!("goal") };
        assert_eq!((goal.robot.radius_m, goal.stand.limit), (0.3, 3));
        let Command::List(list) = command("slag-edge list --near 1,-2,0 --radius 3 --sort area --format csv")
        else {
            panic!("list")
        };
        assert_eq!((list.sort, list.format), (ObjectOrder::Area, Some(ListFormat::Csv)));
        command("slag-edge query chair --encoder clip --provider tensorrt,cuda,cpu --model-threads 2");
        command("slag-edge locate a.jpg --focal-px 554.3 --gravity 0,1,0 --cache c --json");
        command("slag-edge fetch --radius 0 --margin 1e9 --from http://[::1]:7733/store/");
        // As for questions: a flat box is empty, and no scene is opened.
        let flat = parse("slag-edge list --box 0,0,1,5,5,1 --cache nowhere").expect("a line");
        assert_eq!(flat.run(), Exit::Usage);
    }

    #[test]
    fn wrong_lines_are_refused() {
        let wrong = "; query; query chair --radius 4; query chair --near 1,2; query chair --near NaN,0,0; \
            query chair --kind points; query chair --limit -1; query chair --box 1,2,3; \
            query chair --negatives ,; goal; list --near 1,2,3; list --radius 3; list --sort size; \
            list --format csv --json; locate a.jpg; locate a.jpg --focal-px 0; changes --from first; \
            goal chair --near 1,2; fetch --at 1,2,3 --at-geo 1,2; fetch --at-geo 91,0; \
            trust add http://a; trust add http://a --trust-first --root f; trust add --trust-first; \
            fetch --margin; fetch --profile tiny";
        // Unreachably long distances would be retried for ever.
        let far = "fetch --watch --radius 1.7e308; fetch --radius 1e10; fetch --margin 1e10; \
            fetch --margin 0; serve --margin -1; serve --radius inf; list --near 0,0,0 --radius 1e10; \
            fetch --at-geo 46.8,-92,1e300";
        // Wrong stores are refused before anything starts.
        let stores = "serve --follow base:7733; fetch --from ftp://x; fetch --from http://a:70000; \
            trust add --trust-first http://a@b; serve --listen nowhere; status --quiet --verbose; \
            serve --threads 0; serve --threads 257; query chair --threads 100000; \
            query chair --model-threads 257; query chair --provider gpu; models; models pull";
        for line in [wrong, far, stores].iter().flat_map(|lines| lines.split("; ")) {
            let line = &format!("slag-edge {line}");
            assert_eq!(parse(line.trim_end()).expect_err(line).exit_code(), Exit::Usage as i32, "{line}");
        }
    }
}
