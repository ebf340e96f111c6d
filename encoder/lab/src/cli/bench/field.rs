//! `bench field`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::parse_error;
use slag_encoder::codebook::CodebookSettings;
use slag_encoder::progress::Progress;
use slag_encoder::shard::ShardSettings;

use crate::bench::field;

/// `bench field`.
#[derive(Debug, Args)]
pub struct FieldBenchArgs {
    /// Store to publish into.
    #[arg(long, value_name = "DIR")]
    store: PathBuf,
    /// Gaussians, rounded down to whole cells of 62,500.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(1000..=100_000_000))]
    gaussians: u32,
    /// Components.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=4096))]
    dim: u32,
    /// Profiles to make.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_values_t = [Profile::Compact, Profile::Balanced])]
    profiles: Vec<Profile>,
    /// Error of the balanced profile, relative to the spread of scores.
    #[arg(long, value_name = "E", default_value_t = CodebookSettings::default().balanced_error, value_parser = parse_error)]
    balanced_error: f32,
    /// Writes the report as JSON to this file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &FieldBenchArgs, progress: &dyn Progress) -> Result<Exit> {
    let settings = ShardSettings {
        profiles: args.profiles.clone(),
        codebook: CodebookSettings { balanced_error: args.balanced_error, ..CodebookSettings::default() },
        input_indices: false,
        appearance: false,
    };
    let report =
        field::publish(args.gaussians as usize, args.dim as usize, &args.store, &settings, progress)?;
    let text = serde_json::to_string_pretty(&report)?;
    if let Some(path) = &args.out {
        fs_err::write(path, &text)?;
    }
    println!("{text}");
    Ok(Exit::Done)
}
