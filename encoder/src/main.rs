//! `slag-encoder`: encodes a 3DGS scene, cuts it into shards and serves them.

use std::process::ExitCode;

use clap::Parser;
use slag_encoder::cli::{self, Cli, devices};

fn main() -> ExitCode {
    let cli = Cli::parse();
    if cli.uses_gpu() {
        devices::silence_device_selection();
    }
    cli.output.init_logging();
    cli::run(cli).into()
}
