//! `eval encoder`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, open_models};
use slag_encoder::progress::Progress;

use super::output::Output;
use crate::eval::encoder;
use crate::generate::grammar;

/// `eval encoder`.
#[derive(Debug, Args)]
pub struct EvalEncoderArgs {
    /// The encoder.
    #[command(flatten)]
    models: ModelArgs,
    /// Number of scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 300)]
    n_scenes: u64,
    /// Seed of the first scene; the others follow. The embedded encoders were trained on seeds 1000000 to 1012799.
    #[arg(long, default_value_t = 9_000_000)]
    seed: u64,
    /// Writes a picture of the confusion matrix to this file.
    #[arg(long, value_name = "PNG")]
    confusion: Option<PathBuf>,
}

pub(super) fn run(args: &EvalEncoderArgs, progress: &dyn Progress, output: &Output<'_>) -> Result<Exit> {
    let (models, session) = open_models(&args.models)?;
    let nouns = grammar::nouns(None)?;
    let seeds = args.seed..args.seed + args.n_scenes;
    let report = encoder::evaluate(&models, &session, &nouns, seeds, args.confusion.as_deref(), progress)?;
    output.print(&report)?;
    Ok(Exit::Done)
}
