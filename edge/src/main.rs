//! `slag-edge`: fetches shards and answers questions about them.

use std::io::IsTerminal;
use std::process::ExitCode;

use slag_edge::cli;
use slag_models::restart::{NO_TELEMETRY, restart_with};
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    restart_with(&[NO_TELEMETRY]);
    let cli = match cli::parse() {
        Ok(cli) => cli,
        Err(exit) => return exit.into(),
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(cli.log_filter()));
    let ansi = std::io::stderr().is_terminal();
    // Module names mean nothing to users.
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(ansi).with_target(false);
    // It would panic if nobody reads stderr any more.
    log.log_internal_errors(false).with_writer(std::io::stderr).init();
    cli.run().into()
}
