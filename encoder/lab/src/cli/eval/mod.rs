//! `eval`: stores and encoders against labels.

mod comparison;
mod defaults;
mod encoder;
mod goal;
mod labelled;
mod lerf;
mod noise;
mod protocol;
mod relations;
mod scannet;

use anyhow::Result;
use clap::Subcommand;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

/// `eval`.
#[derive(Debug, Subcommand)]
pub enum EvalCommand {
    /// Evaluates a store of a scene with a label for every Gaussian, such as those of `generate scene`.
    Labelled(labelled::EvalLabelledArgs),
    /// Evaluates a store on LangSplat's labels of LERF scenes (LERF-OVS).
    Lerf(lerf::EvalLerfArgs),
    /// Evaluates stores on ScanNet's labelled meshes with OpenGaussian's protocol.
    Scannet(scannet::EvalScannetArgs),
    /// Writes one page with the figures of `eval lerf` and `eval scannet` beside the paper's rows, by the protocol's rules.
    Report(protocol::EvalReportArgs),
    /// Evaluates an encoder on crops of generated things: noun, colour and material.
    Encoder(encoder::EvalEncoderArgs),
    /// Compares the plain average with the default on labelled scenes, with true and automatic masks.
    Defaults(defaults::EvalDefaultsArgs),
    /// Measures the accuracy of each aggregation method with errors in the masks.
    Noise(noise::EvalNoiseArgs),
    /// Asks the robot's program for places to stand near the things of generated scenes, and compares with their true surfaces.
    Goal(goal::EvalGoalArgs),
    /// Asks the robot's program for things by their relations in generated scenes, beside the plain phrase and the noun.
    Relations(relations::EvalRelationsArgs),
}

pub(super) fn run(command: &EvalCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        EvalCommand::Labelled(args) => labelled::run(args, json),
        EvalCommand::Lerf(args) => lerf::run(args, json),
        EvalCommand::Scannet(args) => scannet::run(args, json),
        EvalCommand::Report(args) => protocol::run(args),
        EvalCommand::Encoder(args) => encoder::run(args, progress, json),
        EvalCommand::Defaults(args) => defaults::run(args, progress, json),
        EvalCommand::Noise(args) => noise::run(args, progress, json),
        EvalCommand::Goal(args) => goal::run(args, progress, json),
        EvalCommand::Relations(args) => relations::run(args, progress, json),
    }
}
