//! `eval`: answers and encoders against labels.

mod encoder;
mod labelled;
mod lerf;
mod noise;
mod scannet;

use anyhow::Result;
use clap::Subcommand;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

/// `eval`.
#[derive(Debug, Subcommand)]
pub enum EvalCommand {
    /// Against a scene whose every Gaussian has a label (`generate scene` makes such scenes).
    Labelled(labelled::EvalLabelledArgs),
    /// Against LangSplat's labels of LERF scenes (LERF-OVS).
    Lerf(lerf::EvalLerfArgs),
    /// Against ScanNet's labelled meshes, with OpenGaussian's protocol.
    Scannet(scannet::EvalScannetArgs),
    /// On crops of generated things: which noun, colour and material they show.
    Encoder(encoder::EvalEncoderArgs),
    /// How much each way to aggregate loses with errors in the masks.
    Noise(noise::EvalNoiseArgs),
}

pub(super) fn run(command: &EvalCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        EvalCommand::Labelled(args) => labelled::run(args, json),
        EvalCommand::Lerf(args) => lerf::run(args, json),
        EvalCommand::Scannet(args) => scannet::run(args, json),
        EvalCommand::Encoder(args) => encoder::run(args, progress, json),
        EvalCommand::Noise(args) => noise::run(args, progress, json),
    }
}
