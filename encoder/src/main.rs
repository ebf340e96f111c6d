//! `slag-encoder`: encodes a 3DGS scene, cuts it into shards and serves them.

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches};
use slag_encoder::cli::{self, Cli, devices};
use slag_models::restart::{NO_TELEMETRY, restart_with};

fn main() -> ExitCode {
    let matches = slag_models::help::layered(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    let of_gpu = if cli.uses_gpu() { devices::no_device_selection() } else { None };
    let variables: Vec<(&str, &str)> = [NO_TELEMETRY].into_iter().chain(of_gpu).collect();
    restart_with(&variables);
    cli.output.init_logging();
    cli::run(cli).into()
}
