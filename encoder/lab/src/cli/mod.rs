//! The command line: flags in, exit code out. The flags of a benchmark or an evaluation stand beside its code.

mod generate;
#[cfg(feature = "measure")]
mod measure;

use anyhow::Result;
use clap::{Parser, Subcommand};
use slag_encoder::cli::common::{OutputArgs, print};
use slag_encoder::cli::{Exit, exit_of, progress};
use slag_encoder::progress::Progress;

use crate::demo::{self, DemoArgs};

/// Generates scenes with known contents, evaluates encoders and stores on them, and benchmarks this machine.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// Flags that every command has.
    #[command(flatten)]
    pub output: OutputArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Evaluates stores and encoders against labels.
    #[cfg(feature = "measure")]
    #[command(subcommand)]
    Eval(measure::EvalCommand),
    /// Generates scenes, crops and photos with known contents.
    #[command(subcommand)]
    Generate(generate::GenerateCommand),
    /// Generates a room and a yard, then encodes, serves, fetches and queries them.
    Demo(DemoArgs),
    /// Benchmarks this machine.
    #[cfg(feature = "measure")]
    #[command(subcommand)]
    Bench(measure::BenchCommand),
}

pub fn run(cli: Cli) -> Exit {
    let json = cli.output.json;
    let progress = progress::shown(cli.output.shows_progress());
    let progress = progress.as_ref();
    let result = match cli.command {
        #[cfg(feature = "measure")]
        Command::Eval(args) => measure::eval(&args, progress, json),
        Command::Generate(command) => generate::run(&command, progress),
        Command::Demo(args) => run_demo(&args, progress, json),
        #[cfg(feature = "measure")]
        Command::Bench(command) => measure::bench(&command, progress, json),
    };
    exit_of(result, json)
}

fn run_demo(args: &DemoArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let report = demo::run(args, progress)?;
    print(json, &report, &report)?;
    if args.keep {
        demo::keep(args, &report)?;
    }
    Ok(if report.all_right() { Exit::Done } else { Exit::Failed })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn flags_are_consistent() {
        Cli::command().debug_assert();
    }
}
