//! The command line, a file a command: flags in, exit code out. Data goes to stdout, everything else to stderr.

mod check;
mod choices;
pub mod common;
pub mod devices;
mod diff;
pub mod draw;
mod encode;
#[cfg(feature = "fleet")]
mod fleet;
mod keys;
pub mod memory;
mod next;
pub mod progress;
#[cfg(feature = "qdrant")]
mod push;
mod query;
mod serve;
mod store;
mod summary;
mod view;

use std::io::{self, Write};

use anyhow::Result;
use clap::{CommandFactory, Parser, Subcommand};
use serde_json::json;
use slag_common::{error_line, note};
use slag_models::commands::{self, ModelsCommand};
use slag_models::help;
use slag_models::hub::Side;

use crate::encode::EncodeError;
#[cfg(feature = "qdrant")]
use crate::publish::qdrant;
use crate::raster::devices::DeviceChoice;
pub use common::Exit;
use common::{OutputArgs, ReaderGone, print, to_stdout};
#[cfg(feature = "qdrant")]
use push::PushCommand;

/// Makes 3D Gaussian splatting scenes searchable by words.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// Flags that every command has.
    #[command(flatten)]
    pub output: OutputArgs,
    /// The command.
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    pub fn uses_gpu(&self) -> bool {
        cfg!(feature = "gpu")
            && match &self.command {
                Command::Check(args) => args.device != DeviceChoice::Cpu,
                Command::Encode(args) => args.device != DeviceChoice::Cpu,
                Command::Plan(args) => args.drawing.device != DeviceChoice::Cpu,
                Command::Draw(args) => args.drawing.device != DeviceChoice::Cpu,
                #[cfg(feature = "fleet")]
                Command::Worker(args) => args.device != DeviceChoice::Cpu,
                Command::Devices => true,
                _ => false,
            }
    }
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Compares renderings of the scene with the photos: do poses and scene fit?
    ///
    /// Where they do not, it names the likely mistake: camera axes, world axes, scale, nerfstudio's training frame
    /// without its dataparser_transforms.json. A similarity that brings both into one frame is stated, and written
    /// by
    /// --write-frame for `encode --splat-frame`.
    Check(check::CheckArgs),
    /// Plans views of a splat without photos, and draws them.
    ///
    /// Writes images and a transforms.json with a verdict for each: holes, near, haze, large, as shares of the image.
    /// `encode` without --views does the same by itself.
    Plan(draw::PlanArgs),
    /// Draws a splat at given poses: images, and a transforms.json that says so.
    Draw(draw::DrawArgs),
    /// Encodes a scene into a store.
    Encode(Box<encode::EncodeArgs>),
    /// Does views and cells of an encode that another machine coordinates (`encode --blobs`), until it is
    /// published.
    #[cfg(feature = "fleet")]
    Worker(Box<fleet::WorkerArgs>),
    /// Scores every Gaussian of a store against a text, in full precision.
    Query(query::QueryArgs),
    /// Lists the things that appeared, went or moved between two generations, and what robots have to fetch.
    Diff(diff::DiffArgs),
    /// Serves a store's manifest and shards over HTTP.
    Serve(serve::ServeArgs),
    /// Draws a store or a splat on a page, and asks it.
    View(Box<view::ViewArgs>),
    /// Shows, makes and rotates the key that a store signs with.
    #[command(subcommand)]
    Keys(keys::KeysCommand),
    /// Lists, verifies and tidies a store.
    #[command(subcommand)]
    Store(store::StoreCommand),
    /// Lists, pulls and checks public models.
    #[command(subcommand)]
    Models(ModelsCommand),
    /// Copies a store into a vector database.
    #[cfg(feature = "qdrant")]
    #[command(subcommand)]
    Push(push::PushCommand),
    /// Lists the GPUs that can rasterise.
    Devices,
    /// Prints completions for a shell.
    Completions {
        /// The shell.
        #[arg(value_enum)]
        shell: clap_complete::Shell,
    },
}

pub fn run(cli: Cli) -> Exit {
    let json = cli.output.json;
    let progress = progress::shown(cli.output.shows_progress());
    let result = match cli.command {
        Command::Check(args) => check::run(&args, json),
        Command::Plan(args) => draw::plan(&args, progress.as_ref(), json),
        Command::Draw(args) => draw::draw(&args, progress.as_ref(), json),
        Command::Encode(args) => encode::run(&args, progress.as_ref(), json),
        #[cfg(feature = "fleet")]
        Command::Worker(args) => fleet::run(&args, json),
        Command::Query(args) => query::run(&args, json),
        Command::Diff(args) => diff::run(&args, json),
        Command::Serve(args) => serve::run(&args),
        Command::View(args) => view::run(&args),
        Command::Keys(command) => keys::run(&command, json),
        Command::Store(command) => store::run(&command, progress.as_ref(), json),
        Command::Models(command) => models(&command, json),
        #[cfg(feature = "qdrant")]
        Command::Push(PushCommand::Qdrant(args)) => push::run(&args, progress.as_ref(), json),
        Command::Devices => devices::run(json),
        Command::Completions { shell } => {
            let (mut command, mut text) = (help::layered(Cli::command()), Vec::new());
            clap_complete::generate(shell, &mut command, "slag-encoder", &mut text);
            to_stdout(&String::from_utf8_lossy(&text)).map(|()| Exit::Done)
        }
    };
    exit_of(result, json)
}

fn models(command: &ModelsCommand, json: bool) -> Result<Exit> {
    let context = commands::Context {
        variable: &|name| std::env::var_os(name),
        side: Side::Both,
        ask: &|question| !json && commands::ask(question),
    };
    let report = commands::run(command, &context)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

/// Prints the error of a command, if any, and returns the exit code.
pub fn exit_of(result: Result<Exit>, json: bool) -> Exit {
    match result {
        Ok(exit) => exit,
        Err(error) if error.is::<ReaderGone>() => Exit::Done,
        Err(error) => {
            let interrupted = matches!(error.downcast_ref(), Some(EncodeError::Interrupted { .. }));
            #[cfg(feature = "qdrant")]
            let interrupted =
                interrupted || matches!(error.downcast_ref(), Some(qdrant::PushError::Cancelled));
            if json {
                let error = json!({"error": {"message": error_line(&*error), "interrupted": interrupted}});
                let _ = writeln!(io::stdout(), "{error}");
            } else {
                let kind = if interrupted { "interrupted" } else { "error" };
                note(format_args!("{kind}: {}", error_line(&*error)));
            }
            if interrupted { Exit::Interrupted } else { Exit::Failed }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bucket or database that hangs up breaks a pipe, too, and that is a failure.
    #[test]
    fn only_the_reader_of_stdout_may_leave() {
        assert_eq!(exit_of(Err(io::Error::from(io::ErrorKind::BrokenPipe).into()), false), Exit::Failed);
        assert_eq!(exit_of(Err(ReaderGone.into()), false), Exit::Done);
    }

    #[test]
    fn flags_are_consistent_and_checked() {
        Cli::command().debug_assert();
        let parse = |line: &str| Cli::try_parse_from(line.split(' '));
        assert!(
            parse("slag-encoder encode --scene a.ply --views v --store s --memory 512MiB --masks auto")
                .is_ok()
        );
        let wrong = "--memory 1,--memory 5TB,--views-limit 0,--views-limit 0%,--views-limit 101%,--views-limit NaN%,--raster-width \
                     wide,--view-order best,--time-budget 0,--time-budget inf,--threads 0,--threads 1025,--model-threads 257,\
                     --sam-threads 1025,--preset best";
        for wrong in wrong.split(',') {
            let line = format!("slag-encoder encode --scene a.ply --views v --store s {wrong}");
            assert!(parse(&line).is_err(), "{wrong}");
        }
    }
}
