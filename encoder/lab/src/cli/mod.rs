//! The command line, a file a command: flags in, exit code out.

mod bench;
mod demo;
mod eval;
mod generate;

use clap::{Parser, Subcommand};
use slag_encoder::cli::{Exit, exit_of, progress};

/// Generates scenes with known contents, evaluates encoders and stores on them, and benchmarks this machine.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// Prints less: no progress, warnings only.
    #[arg(long, short, global = true)]
    quiet: bool,
    /// Prints the result, or the error, as one JSON object.
    #[arg(long, global = true)]
    pub json: bool,
    /// The command.
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    /// Returns the log level; RUST_LOG overrides it.
    pub fn log_level(&self) -> &'static str {
        if self.quiet { "warn" } else { "info" }
    }

    /// Returns whether progress may be shown.
    pub fn shows_progress(&self) -> bool {
        !self.quiet && !self.json
    }
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Evaluates answers against labels.
    #[command(subcommand)]
    Eval(eval::EvalCommand),
    /// Generates scenes, crops and photos with known contents.
    #[command(subcommand)]
    Generate(generate::GenerateCommand),
    /// Generates a house and yard, encodes, serves, fetches and queries them: the whole system in one command.
    Demo(demo::DemoArgs),
    /// Benchmarks this machine.
    #[command(subcommand)]
    Bench(bench::BenchCommand),
}

/// Runs a command and returns the exit code.
pub fn run(cli: Cli) -> Exit {
    let json = cli.json;
    let progress = progress::shown(cli.shows_progress());
    let progress = progress.as_ref();
    let result = match cli.command {
        Command::Eval(command) => eval::run(&command, progress, json),
        Command::Generate(command) => generate::run(&command, progress),
        Command::Demo(args) => demo::run(&args, progress, json),
        Command::Bench(command) => bench::run(&command, progress, json),
    };
    exit_of(result, json)
}
