//! `bench codec`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, open_models, print};
use slag_encoder::codebook::TextBank;

use crate::bench::codec::{self, Source};

/// `bench codec`.
#[derive(Debug, Args)]
pub struct CodecBenchArgs {
    /// Store with exact shards [default: a generated field].
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,
    /// Gaussians of the generated field.
    #[arg(long, value_name = "N", default_value_t = 125_000, value_parser = clap::value_parser!(u32).range(1000..=10_000_000))]
    gaussians: u32,
    /// Components of the generated field.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(2..=4096))]
    dim: u32,
    /// Title of the plot [default: the store's folder].
    #[arg(long)]
    title: Option<String>,
    /// Writes the plot to this file.
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Writes the report as JSON to this file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Models of the store's text bank.
    #[command(flatten)]
    models: ModelArgs,
}

pub(super) fn run(args: &CodecBenchArgs, json: bool) -> Result<Exit> {
    let generated = || Source::Generated(args.gaussians as usize, args.dim as usize);
    let source = args.store.clone().map_or_else(generated, Source::Store);
    let (bank, name) = match &args.store {
        Some(store) => {
            let (models, session) = open_models(&args.models)?;
            let name = store.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
            (TextBank::of_model(&mut *models.text_encoder(&session)?), name)
        }
        None => (TextBank::default(), "generated field".into()),
    };
    let report = codec::run(&source, bank, args.title.as_deref().unwrap_or(&name))?;
    if let Some(path) = &args.svg {
        fs_err::write(path, report.svg())?;
    }
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
