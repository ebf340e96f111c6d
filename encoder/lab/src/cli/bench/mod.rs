//! `bench`: measures this machine.

mod codec;
mod field;
mod fleet;
mod inference;
mod lift;
mod partition;
mod raster;
mod robot;
mod sibling;
mod tradeoff;

use anyhow::Result;
use clap::Subcommand;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

/// `bench`.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Compares bytes and score errors of shards, 8-bit vectors and product quantisation.
    Codec(codec::CodecBenchArgs),
    /// Publishes a store of a generated field for `slag-edge bench query`.
    Field(field::FieldBenchArgs),
    /// Simulates fleets of many machines with the measured times and bytes of an encode, beside fixed batches.
    Fleet(fleet::FleetArgs),
    /// Times image models and Segment Anything on GPUs, as `encode` runs them.
    Inference(inference::InferenceArgs),
    /// Times the weights of a view: each device on generated scenes, or on a recorded one.
    Raster(raster::RasterBenchArgs),
    /// Times the way from the contributions of all views to embeddings, on a synthetic scene.
    Lift(lift::LiftBenchArgs),
    /// Measures what a robot downloads, and how long it takes, by radius and width of cells.
    Partition(partition::PartitionArgs),
    /// Fills the paper's table of query times on the robot, with other engines on the same vectors beside it.
    Robot(robot::RobotArgs),
    /// Measures cost and accuracy of settings of `encode` on labelled scenes: table, Pareto front and plots.
    Tradeoff(tradeoff::TradeoffArgs),
}

pub(super) fn run(command: &BenchCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        BenchCommand::Codec(args) => codec::run(args, json),
        BenchCommand::Field(args) => field::run(args, progress),
        BenchCommand::Fleet(args) => fleet::run(args, json),
        BenchCommand::Inference(args) => inference::run(args, json),
        BenchCommand::Raster(args) => raster::run(args, progress, json),
        BenchCommand::Lift(args) => lift::run(args, json),
        BenchCommand::Partition(args) => partition::run(args, progress, json),
        BenchCommand::Robot(args) => robot::run(args, progress, json),
        BenchCommand::Tradeoff(args) => tradeoff::run(args, progress, json),
    }
}
