//! `slag-ros`: a robot's answers on ROS 2 topics and services.

use std::io;
use std::process::ExitCode;

use anyhow::Result;
use clap::Parser;
use slag_ros::{Args, node};
use slag_service::stop::stop_signal;
use tracing_subscriber::EnvFilter;

/// Async threads: they only forward messages.
const ASYNC_THREADS: usize = 2;

fn main() -> ExitCode {
    let default = "warn,slag_ros=info";
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false);
    // It would panic if nobody reads stderr any more.
    log.log_internal_errors(false).with_writer(io::stderr).init();
    match run(Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            slag_robot::note(format_args!("slag-ros: {error:#}"));
            ExitCode::FAILURE
        }
    }
}

fn run(args: Args) -> Result<()> {
    let robot = args.robot.open()?;
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(ASYNC_THREADS).enable_all().build()?;
    runtime.block_on(async { node::run(args, robot, stop_signal()?).await })?;
    runtime.shutdown_background();
    Ok(())
}
