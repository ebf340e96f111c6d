//! `slag-lab`: generates scenes, evaluates encodings on them, and benchmarks this machine.

use std::io::IsTerminal;
use std::process::ExitCode;

use clap::Parser;
use slag_lab::cli::{self, Cli};

fn main() -> ExitCode {
    let cli = Cli::parse();
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| cli.log_level().into()),
        )
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .without_time()
        .init();
    cli::run(cli).into()
}
