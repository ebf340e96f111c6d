//! `bench`: measures this machine.

mod codec;
mod field;
mod lift;
mod raster;
mod tradeoff;

use anyhow::Result;
use clap::Subcommand;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

/// `bench`.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Bytes against errors of the shards' codes, beside plain 8 bits and product quantisation.
    Codec(codec::CodecBenchArgs),
    /// Publishes a store of a generated field, for `slag-edge bench query`.
    Field(field::FieldBenchArgs),
    /// Weights of a view: each device on generated scenes, or on a recorded one.
    Raster(raster::RasterBenchArgs),
    /// From the contributions of all views to every Gaussian's embedding, on a made-up scene.
    Lift(lift::LiftBenchArgs),
    /// Costs and accuracy of the choices of `encode` on labelled scenes: table, Pareto front and plots.
    Tradeoff(tradeoff::TradeoffArgs),
}

pub(super) fn run(command: &BenchCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        BenchCommand::Codec(args) => codec::run(args, json),
        BenchCommand::Field(args) => field::run(args, progress),
        BenchCommand::Raster(args) => raster::run(args, progress, json),
        BenchCommand::Lift(args) => lift::run(args, json),
        BenchCommand::Tradeoff(args) => tradeoff::run(args, progress, json),
    }
}
