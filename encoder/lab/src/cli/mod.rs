//! The command line, a file a command: flags in, exit code out.

mod bench;
mod demo;
mod eval;
mod generate;
mod labelled;
mod noise;
mod tradeoff;

use clap::{Parser, Subcommand};
use slag_encoder::cli::{Exit, exit_of, progress};

use bench::{CodecBenchArgs, FieldBenchArgs, LiftBenchArgs, RasterBenchArgs};
use eval::{EvalEncoderArgs, EvalLerfArgs, EvalScannetArgs};
use labelled::EvalLabelledArgs;
use noise::EvalNoiseArgs;
use tradeoff::TradeoffArgs;

/// Generates scenes whose contents are known, judges encoders and stores by them, and measures this machine.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// Prints less: no progress, warnings only.
    #[arg(long, short, global = true)]
    quiet: bool,
    /// Prints the result, or the error, as one JSON object.
    #[arg(long, global = true)]
    pub json: bool,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    /// Returns the log level where RUST_LOG does not say otherwise.
    pub fn log_level(&self) -> &'static str {
        if self.quiet { "warn" } else { "info" }
    }

    /// Returns whether progress may be shown.
    pub fn shows_progress(&self) -> bool {
        !self.quiet && !self.json
    }
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Measures answers against labels.
    #[command(subcommand)]
    Eval(EvalCommand),
    /// Makes scenes and crops whose contents are known.
    #[command(subcommand)]
    Generate(generate::GenerateCommand),
    /// Generates a house and yard, encodes, serves, fetches and asks: the whole system in one command.
    Demo(demo::DemoArgs),
    /// Measures this machine.
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// `eval`.
#[derive(Debug, Subcommand)]
pub enum EvalCommand {
    /// Against a scene whose every Gaussian has a label (`generate scene` makes such).
    Labelled(EvalLabelledArgs),
    /// Against LangSplat's labels of LERF scenes (LERF-OVS).
    Lerf(EvalLerfArgs),
    /// Against ScanNet's labelled meshes, with OpenGaussian's protocol.
    Scannet(EvalScannetArgs),
    /// On crops of generated things: which noun, colour and material they show.
    Encoder(EvalEncoderArgs),
    /// How each way to aggregate falls with errors laid over true masks.
    Noise(EvalNoiseArgs),
}

/// `bench`.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Bytes against errors of the shards' codes, beside plain 8 bits and product quantisation.
    Codec(CodecBenchArgs),
    /// Publishes a store of a generated field, for `slag-edge bench query`.
    Field(FieldBenchArgs),
    /// Weights of a view: each device on generated scenes, or on a recorded one.
    Raster(RasterBenchArgs),
    /// From the sparse sums of all views to every Gaussian's embedding, on a made-up scene.
    Lift(LiftBenchArgs),
    /// What each choice of `encode` costs and gives, on labelled scenes: table, front and plots.
    Tradeoff(TradeoffArgs),
}

/// Runs the program and says how it ended.
pub fn run(cli: Cli) -> Exit {
    let json = cli.json;
    let progress = progress::shown(cli.shows_progress());
    let progress = progress.as_ref();
    let result = match cli.command {
        Command::Eval(EvalCommand::Labelled(args)) => labelled::run(&args, json),
        Command::Eval(EvalCommand::Encoder(args)) => eval::run_encoder(&args, progress, json),
        Command::Eval(EvalCommand::Lerf(args)) => eval::run_lerf(&args, json),
        Command::Eval(EvalCommand::Scannet(args)) => eval::run_scannet(&args, json),
        Command::Eval(EvalCommand::Noise(args)) => noise::run(&args, progress, json),
        Command::Generate(command) => generate::run(&command, progress),
        Command::Demo(args) => demo::run(&args, progress, json),
        Command::Bench(BenchCommand::Raster(args)) => bench::run_raster(&args, progress, json),
        Command::Bench(BenchCommand::Lift(args)) => bench::run_lift(&args, json),
        Command::Bench(BenchCommand::Codec(args)) => bench::run_codec(&args, json),
        Command::Bench(BenchCommand::Field(args)) => bench::run_field(&args, progress),
        Command::Bench(BenchCommand::Tradeoff(args)) => tradeoff::run(&args, progress, json),
    };
    exit_of(result, json)
}
