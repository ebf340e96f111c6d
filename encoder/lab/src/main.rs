//! `slag-lab`: generates scenes, evaluates encodings on them, and benchmarks this machine.

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches};
use slag_lab::cli::{self, Cli};
use slag_models::restart::{NO_TELEMETRY, restart_with};

fn main() -> ExitCode {
    let matches = slag_models::help::layered(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    restart_with(&[NO_TELEMETRY]);
    cli.output.init_logging();
    cli::run(cli).into()
}
