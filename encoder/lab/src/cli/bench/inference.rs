//! `bench inference`.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, available_threads, open_models, print};
use slag_models::commands;
use slag_models::gpus::GpuChoice;

use crate::bench::inference::{self, InferenceOptions, Rivals};

/// `bench inference`.
#[derive(Debug, Args)]
pub struct InferenceArgs {
    /// The image model, and how models run.
    #[command(flatten)]
    models: ModelArgs,
    /// Leaves the image model out.
    #[arg(long)]
    no_crops: bool,
    /// Segment Anything: a folder with model.toml, or the name of a pulled model [default: left out].
    #[arg(long, value_name = "NAME|DIR")]
    segmenter: Option<PathBuf>,
    /// NVIDIA GPUs: the first alone is measured, then all of these.
    #[arg(long, value_name = "all|N,...", default_value_t)]
    gpus: GpuChoice,
    /// Points along each side of Segment Anything's grid.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [32, 16], value_parser = clap::value_parser!(u32).range(1..=256))]
    grids: Vec<u32>,
    /// Points per run of the decoder.
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=1024))]
    points_per_batch: u32,
    /// Seconds of each measurement.
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    secs: f64,
    /// Python with torch, transformers and onnxruntime-gpu, to measure the same models in them.
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// ONNX file of the image model for Python.
    #[arg(long, value_name = "FILE", requires = "python")]
    image_onnx: Option<PathBuf>,
    /// ONNX files of Segment Anything for Python: image encoder and mask decoder.
    #[arg(long, value_name = "FILE", num_args = 2, requires = "python")]
    sam_onnx: Option<Vec<PathBuf>>,
    /// Writes the figures as JSON into this file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &InferenceArgs, json: bool) -> Result<Exit> {
    let (models, session) = open_models(&args.models)?;
    let segmenter =
        args.segmenter.as_deref().map(|name| commands::resolve(name, &|name| std::env::var_os(name)));
    let rivals = args.python.clone().map(|python| Rivals {
        python,
        image: args.image_onnx.clone(),
        sam: args.sam_onnx.clone().and_then(|files| files.try_into().ok()),
    });
    let options = InferenceOptions {
        models: (!args.no_crops).then_some(models),
        segmenter: segmenter.transpose()?,
        gpus: args.gpus.numbers(&session),
        session,
        grids: args.grids.clone(),
        points_per_batch: args.points_per_batch,
        secs: args.secs,
        n_threads: available_threads(),
        rivals,
    };
    let report = inference::run(&options)?;
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
