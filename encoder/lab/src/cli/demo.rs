//! `demo`: the whole system in one command.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{cancel_flag, now_unix_secs, print, runtime, session_options};
use slag_encoder::progress::Progress;
use slag_models::commands::RunArgs;

use crate::demo;

#[derive(Debug, Args)]
pub(super) struct DemoArgs {
    /// Working folder; an earlier demo in it is deleted.
    #[arg(long, value_name = "DIR", default_value = "target/demo")]
    out: PathBuf,
    /// Seed of room and yard.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Model runtime.
    #[command(flatten)]
    how: RunArgs,
    /// Keeps the services running until ctrl-c, for queries of your own.
    #[arg(long)]
    keep: bool,
}

pub(super) fn run(args: &DemoArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let edge = std::env::current_exe()?.with_file_name(format!("slag-edge{}", std::env::consts::EXE_SUFFIX));
    let options = demo::DemoOptions {
        out: args.out.clone(),
        seed: args.seed,
        session: session_options(&args.how)?,
        edge,
        created_unix_secs: now_unix_secs(),
    };
    let demo = runtime()?.block_on(async { demo::run(&options, progress, cancel_flag()?.as_ref()).await })?;
    print(json, &demo.report, &demo.report)?;
    if args.keep {
        demo.keep()?;
    }
    Ok(if demo.report.all_right() { Exit::Done } else { Exit::Failed })
}
