//! `eval`: stores and encoders against labels.

mod comparison;
mod defaults;
mod encoder;
mod goal;
mod labelled;
mod lerf;
mod noise;
mod output;
mod protocol;
mod relations;
mod scannet;

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::{Args, Subcommand};
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use output::Output;

/// `eval`.
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Writes the result as one HTML file, too.
    #[arg(long, global = true, value_name = "FILE")]
    html: Option<PathBuf>,
    /// What is judged.
    #[command(subcommand)]
    command: EvalCommand,
}

/// The evaluations.
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

pub(super) fn run(args: &EvalArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let output = &Output { json, html: args.html.as_deref() };
    match &args.command {
        EvalCommand::Labelled(args) => labelled::run(args, output),
        EvalCommand::Lerf(args) => lerf::run(args, output),
        EvalCommand::Scannet(args) => scannet::run(args, output),
        EvalCommand::Report(_) if output.html.is_some() => {
            Err(anyhow!("`eval report` writes Markdown to --out; leave out --html"))
        }
        EvalCommand::Report(args) => protocol::run(args),
        EvalCommand::Encoder(args) => encoder::run(args, progress, output),
        EvalCommand::Defaults(args) => defaults::run(args, progress, output),
        EvalCommand::Noise(args) => noise::run(args, progress, output),
        EvalCommand::Goal(args) => goal::run(args, progress, output),
        EvalCommand::Relations(args) => relations::run(args, progress, output),
    }
}
