//! `slag-lab`: generates scenes, evaluates encodings on them, and benchmarks this machine.

use std::process::ExitCode;

use clap::Parser;
use slag_lab::cli::{self, Cli};

fn main() -> ExitCode {
    let cli = Cli::parse();
    cli.output.init_logging();
    cli::run(cli).into()
}
