//! `slag-encoder`: encodes a 3DGS scene, cuts it into shards and serves them.

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches};
use slag_encoder::cli::{self, Cli, devices};

fn main() -> ExitCode {
    let matches = slag_models::help::layered(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    if cli.uses_gpu() {
        devices::silence_device_selection();
    }
    cli.output.init_logging();
    cli::run(cli).into()
}
