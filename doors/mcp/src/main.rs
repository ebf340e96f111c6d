//! `slag-mcp`: a robot's answers as tools of the Model Context Protocol.

use std::io::{self, Write};
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::Parser;
use rmcp::ServiceExt;
use rmcp::transport::async_rw::AsyncRwTransport;
use slag_mcp::stdio::{Ends, MAX_LINE_BYTES, answering};
use slag_mcp::{Args, Tools, http};
use slag_service::listen::bind;
use slag_service::stop::stop_signal;
use tracing_subscriber::EnvFilter;

/// Async threads: they only forward requests.
const ASYNC_THREADS: usize = 2;
/// Concurrent questions to the robot.
const MAX_QUESTIONS: usize = 8;

fn main() -> ExitCode {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_ansi(false);
    // It would panic if nobody reads stderr any more.
    log.log_internal_errors(false).with_writer(io::stderr).init();
    match run(Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            slag_robot::note(format_args!("slag-mcp: {error:#}"));
            ExitCode::FAILURE
        }
    }
}

fn run(args: Args) -> Result<()> {
    let tools = Tools::new(args.robot.open()?);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(ASYNC_THREADS)
        .max_blocking_threads(MAX_QUESTIONS)
        .enable_all()
        .build()?;
    runtime.block_on(async {
        match args.listen {
            None => speak_on_stdio(tools).await,
            Some(listen) => {
                let stop = stop_signal()?;
                let listener = bind(&listen).await?;
                // For scripts that let the system choose a port.
                let _ = writeln!(io::stdout(), "listening on {}{}", listener.url()?, http::PATH);
                http::serve(tools, listener, http::hosts(&listen, args.host), stop).await
            }
        }
    })?;
    // Standard input cannot be interrupted.
    runtime.shutdown_background();
    Ok(())
}

async fn speak_on_stdio(tools: Tools) -> Result<()> {
    let Ends { input, output, written } = answering(tokio::io::stdin(), tokio::io::stdout());
    let messages = AsyncRwTransport::new_server(input, output).with_max_line_length(MAX_LINE_BYTES);
    let service = tools.serve(messages).await.context("no MCP client on stdin")?;
    service.waiting().await?;
    written.await??;
    Ok(())
}
