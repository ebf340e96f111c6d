//! `bench raster`.

use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context, Result};
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{available_threads, print};
use slag_encoder::progress::Progress;
use slag_encoder::raster::CpuWith;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_math::simd::InstructionSet;

use crate::bench::machine::Machine;
use crate::bench::raster::{Device, RasterBench, RasterReport};
use crate::bench::scene::{BenchScene, cell_regions, grid_regions};

/// `bench raster`.
#[derive(Debug, Args)]
pub struct RasterBenchArgs {
    /// Recorded scene: a NumPy archive of means, quats, scales, opacities, viewmats, Ks, width, height.
    #[arg(long, value_name = "FILE")]
    pub fixture: Option<PathBuf>,
    /// Gaussians of the generated scenes [default: 100000,1000000,2000000,8000000; none with --fixture].
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
    /// Timed views per case.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeats: u32,
    /// Concurrent views where throughput is measured.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub views: u32,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Writes the figures as JSON into this file.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// A device to measure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BenchDevice {
    /// The devices of a choice.
    Chosen(DeviceChoice),
    /// The processor with each of its instruction sets.
    CpuEach,
}

impl FromStr for BenchDevice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "cpu-each" { Ok(Self::CpuEach) } else { text.parse().map(Self::Chosen) }
    }
}

pub(super) fn run(args: &RasterBenchArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.map_or_else(available_threads, |n| n as usize))
        .build_global()
        .context("cannot start threads")?;
    let mut devices = Vec::with_capacity(args.device.len());
    for device in &args.device {
        match device {
            BenchDevice::Chosen(choice) => {
                let options = GpuOptions { views_in_flight: args.views as usize, ..GpuOptions::default() };
                let opened = Devices::open(choice, options)?;
                devices.push(Device { name: opened.names().join(", "), rasterizer: Box::new(opened) });
            }
            BenchDevice::CpuEach => devices.extend(
                InstructionSet::available()
                    .iter()
                    .map(|set| Device { name: set.name().into(), rasterizer: Box::new(CpuWith(*set)) }),
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
