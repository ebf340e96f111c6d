//! `bench`.

use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context, Result};
use clap::Args;

use crate::bench::Machine;
use crate::bench::codec::{self, Source};
use crate::bench::field;
use crate::bench::lift::{self, LiftOptions};
use crate::bench::raster::{Device, RasterBench, RasterReport};
use crate::bench::scene::{BenchScene, cell_regions, grid_regions};
use slag_common::shard::Profile;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, available_threads, open_models, parse_bytes, parse_error, print};
use slag_encoder::codebook::{CodebookSettings, TextBank};
use slag_encoder::progress::Progress;
use slag_encoder::raster::CpuLevel;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_encoder::raster::simd::Level;
use slag_encoder::shard::ShardSettings;
use slag_encoder::shard::positions::PositionError;

/// `bench raster`.
#[derive(Debug, Args)]
pub struct RasterBenchArgs {
    /// Recorded scene: a NumPy archive of means, quats, scales, opacities, viewmats, Ks, width, height.
    #[arg(long, value_name = "FILE")]
    pub fixture: Option<PathBuf>,
    /// Gaussians of the generated scenes; without a recorded scene 100000,1000000,2000000,8000000.
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    pub gaussians: Vec<u32>,
    /// Regions of a view; a recorded scene is also measured with a grid of 8 x 6.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "8,64,512,4096",
        value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub regions: Vec<u32>,
    /// Devices to compare: cpu, cpu-each (once per instruction set), gpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", value_delimiter = ',', default_value = "cpu")]
    pub device: Vec<BenchDevice>,
    /// Width of generated views, pixels.
    #[arg(long, value_name = "PX", default_value_t = 648, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    pub width: u32,
    /// Height of generated views, pixels.
    #[arg(long, value_name = "PX", default_value_t = 484, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    pub height: u32,
    /// Timed views a case.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeats: u32,
    /// Views asked for at once where throughput is measured.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub views: u32,
    /// Threads; all cores if absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Writes the figures as JSON into this file.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// What `bench raster` measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BenchDevice {
    /// What a choice opens.
    Chosen(DeviceChoice),
    /// The processor, with each of the instruction sets that it has.
    CpuEach,
}

impl FromStr for BenchDevice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "cpu-each" { Ok(Self::CpuEach) } else { text.parse().map(Self::Chosen) }
    }
}

/// `bench lift`.
#[derive(Debug, Args)]
pub struct LiftBenchArgs {
    /// Gaussians.
    #[arg(long, value_name = "N", default_value_t = 2_000_000, value_parser = clap::value_parser!(u32).range(1..))]
    gaussians: u32,
    /// Views.
    #[arg(long, value_name = "N", default_value_t = 252, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    views: u32,
    /// Masks a view.
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    masks: u32,
    /// Gaussians with a sum, a view.
    #[arg(long, value_name = "N", default_value_t = 400_000, value_parser = clap::value_parser!(u32).range(1..))]
    visible: u32,
    /// Sums of each of these: a Gaussian lies in several regions near their borders.
    #[arg(long, value_name = "X", default_value_t = 1.4, value_parser = parse_ratio)]
    entries_per_visible: f64,
    /// Components of an embedding.
    #[arg(long, value_name = "N", default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..=8192))]
    dim: u32,
    /// Gaussians a cell at most.
    #[arg(long, value_name = "N", default_value_t = 65_536, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    cell_gaussians: u32,
    /// Working memory, as of `encode`.
    #[arg(long, value_name = "BYTES", default_value = "2GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Threads; all cores if absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Times that everything is done.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Folder for the files of sums, removed afterwards; in the system's temporary folder if absent.
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Gaussians of the scene that a plan is made for.
    #[arg(long, value_name = "N", default_value_t = 38_000_000, value_parser = clap::value_parser!(u32).range(1..))]
    plan_gaussians: u32,
    /// Views of that scene.
    #[arg(long, value_name = "N", default_value_t = 1657, value_parser = clap::value_parser!(u32).range(1..))]
    plan_views: u32,
    /// Writes the figures as JSON into this file.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Reads a number of sums a Gaussian.
fn parse_ratio(text: &str) -> Result<f64, String> {
    let ratio: f64 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    if (1.0..=4.0).contains(&ratio) { Ok(ratio) } else { Err(format!("{text:?} is not within 1 to 4")) }
}

pub(super) fn run_lift(args: &LiftBenchArgs, json: bool) -> Result<Exit> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.map_or_else(available_threads, |n| n as usize))
        .build_global()
        .context("cannot start threads")?;
    let in_temporary = || std::env::temp_dir().join(format!("slag-bench-lift-{}", std::process::id()));
    let options = LiftOptions {
        n_gaussians: args.gaussians as usize,
        n_views: args.views as usize,
        n_masks: args.masks as usize,
        n_visible: args.visible as usize,
        entries_per_visible: args.entries_per_visible,
        dim: args.dim as usize,
        cell_gaussians: args.cell_gaussians as usize,
        memory_bytes: args.memory,
        n_repeats: args.repeats as usize,
        work_dir: args.work.clone().unwrap_or_else(in_temporary),
        plan: (args.plan_gaussians as usize, args.plan_views as usize),
    };
    let measured = lift::run(&options);
    lift::clean(&options)?;
    let report = measured?;
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

/// `bench codec`.
#[derive(Debug, Args)]
pub struct CodecBenchArgs {
    /// Store with exact shards; a generated field if absent.
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
    /// Write the plot.
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Write the report as JSON.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    models: ModelArgs,
}

pub(super) fn run_codec(args: &CodecBenchArgs, json: bool) -> Result<Exit> {
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
    /// Which shards to make.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_values_t = [Profile::Compact, Profile::Balanced])]
    profiles: Vec<Profile>,
    /// Error of the balanced profile, relative to the spread of scores.
    #[arg(long, value_name = "E", default_value_t = CodebookSettings::default().balanced_error, value_parser = parse_error)]
    balanced_error: f32,
    /// Write the report as JSON.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub(super) fn run_field(args: &FieldBenchArgs, progress: &dyn Progress) -> Result<Exit> {
    let settings = ShardSettings {
        profiles: args.profiles.clone(),
        codebook: CodebookSettings { balanced_error: args.balanced_error, ..CodebookSettings::default() },
        position_error: PositionError::Within(0.01),
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

pub(super) fn run_raster(args: &RasterBenchArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.map_or_else(available_threads, |n| n as usize))
        .build_global()
        .context("cannot start threads")?;
    let mut devices = Vec::with_capacity(args.device.len());
    for device in &args.device {
        match device {
            BenchDevice::Chosen(choice) => {
                let options = GpuOptions { views_in_flight: args.views as usize, ..GpuOptions::default() };
                let opened = Devices::open(*choice, options)?;
                devices.push(Device { name: opened.names().join(", "), rasterizer: Box::new(opened) });
            }
            BenchDevice::CpuEach => devices.extend(
                Level::available()
                    .into_iter()
                    .map(|level| Device { name: level.name().into(), rasterizer: Box::new(CpuLevel(level)) }),
            ),
        }
    }
    let sizes = match (&args.fixture, args.gaussians.is_empty()) {
        (None, true) => vec![100_000, 1_000_000, 2_000_000, 8_000_000],
        _ => args.gaussians.clone(),
    };
    let n_cases = (sizes.len() + usize::from(args.fixture.is_some())) * args.regions.len();
    progress.begin("bench", "case", (n_cases + usize::from(args.fixture.is_some())) as u64, 0);
    let bench = RasterBench { n_repeats: args.repeats as usize, n_in_flight: args.views as usize };
    let mut report = RasterReport { machine: Machine::here(), cases: Vec::new() };
    let mut measure = |scene: &BenchScene, with_grid: bool| -> Result<()> {
        let (width_px, height_px) = (scene.views[0].intrinsics.width_px, scene.views[0].intrinsics.height_px);
        let grid = with_grid.then(|| grid_regions(width_px, height_px, 8, 6));
        let cells = args.regions.iter().map(|&n| cell_regions(width_px, height_px, n));
        let maps: Vec<_> = grid.into_iter().chain(cells).collect();
        report.cases.extend(bench.run(scene, &maps, &devices, progress)?);
        Ok(())
    };
    if let Some(path) = &args.fixture {
        measure(&BenchScene::read(path)?, true)?;
    }
    for n in sizes {
        measure(&BenchScene::generated(n as usize, args.width, args.height), false)?;
    }
    progress.end();
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
