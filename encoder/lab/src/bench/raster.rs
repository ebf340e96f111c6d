//! `bench raster`: the time of each backend of the rasteriser for the weights of a view.
//!
//! For a scene of any size, `generate copies` makes one.

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, View, poses};
use slag_encoder::masks::RegionMap;
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_encoder::raster::{RasterError, RasterView, Rasterizer};

use crate::harness::{Machine, Times, timed_ms};
use crate::table::Table;

const N_VIEWS: usize = 4;
/// Columns and rows of regions: about as many as a photo's masks make.
const GRID: [u32; 2] = [8, 6];

#[derive(Debug, Args)]
pub(crate) struct RasterArgs {
    /// A splat.
    #[arg(long, value_name = "FILE")]
    scene: PathBuf,
    /// Its poses: the folder of a COLMAP model or transforms.json.
    #[arg(long, value_name = "PATH")]
    views: PathBuf,
    /// Devices to compare: cpu, gpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", value_delimiter = ',', default_value = "cpu")]
    device: Vec<DeviceChoice>,
    /// Width of views, pixels.
    #[arg(long, value_name = "PX", default_value_t = 648, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    width: u32,
    /// Timed views per device.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

/// A splat, and views of one image size; at least one.
struct BenchScene {
    gaussians: Gaussians,
    views: Vec<RasterView>,
}

type Device = (String, Box<dyn Rasterizer>);

#[derive(Clone, Debug, Serialize)]
pub(crate) struct RasterReport {
    machine: Machine,
    cases: Vec<RasterCase>,
}

/// Figures of one device.
#[derive(Clone, Debug, Serialize)]
struct RasterCase {
    device: String,
    n_gaussians: usize,
    width_px: u32,
    height_px: u32,
    n_regions: u32,
    /// Time of a view, one at a time.
    weights: Times,
}

pub(crate) fn run(args: &RasterArgs, progress: &dyn Progress) -> Result<RasterReport> {
    let threads = args.threads.map_or(0, |n| n as usize);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("cannot start threads")?;
    let mut devices: Vec<Device> = Vec::new();
    for choice in &args.device {
        let opened = Devices::open(choice, GpuOptions::default())?;
        devices.push((opened.names().join(", "), Box::new(opened)));
    }
    let scene = BenchScene::read(&args.scene, &args.views, args.width)?;
    progress.begin("bench", "view", u64::from(args.repeats), 0);
    let cases = measure(&scene, &devices, args.repeats, progress)?;
    progress.end();
    Ok(RasterReport { machine: Machine::here(), cases })
}

impl BenchScene {
    fn read(splat: &Path, poses: &Path, width_px: u32) -> Result<Self> {
        let gaussians = splat::read(splat, &ReadOptions { with_sh_rest: false })?;
        let view = |view: &View| {
            let intrinsics = view.intrinsics.without_distortion().scaled_to_width(width_px);
            RasterView { intrinsics, ..RasterView::of(view) }
        };
        let read: Vec<RasterView> = poses::read(poses, None)?.views.iter().map(view).collect();
        let size = |view: &RasterView| (view.intrinsics.width_px, view.intrinsics.height_px);
        let Some(first) = read.first().map(size) else { bail!("{}: no views", poses.display()) };
        let step = read.len().div_ceil(N_VIEWS);
        let views = read.into_iter().filter(|view| size(view) == first).step_by(step).collect();
        Ok(Self { gaussians, views })
    }
}

fn grid_regions(width_px: u32, height_px: u32) -> RegionMap {
    let [columns, rows] = GRID;
    let region = |x: u32, y: u32| y * rows / height_px * columns + x * columns / width_px;
    let region_of_pixel = (0..height_px).flat_map(|y| (0..width_px).map(move |x| region(x, y))).collect();
    RegionMap { width_px, height_px, region_of_pixel, n_regions: columns * rows }
}

/// Measures all devices on a scene; they take turns view by view, so that other load affects all alike.
fn measure(
    scene: &BenchScene,
    devices: &[Device],
    n_repeats: u32,
    progress: &dyn Progress,
) -> Result<Vec<RasterCase>, RasterError> {
    let camera = scene.views[0].intrinsics;
    let regions = &grid_regions(camera.width_px, camera.height_px);
    let mut loaded = Vec::new();
    for (_, rasterizer) in devices {
        let ready = rasterizer.load(&scene.gaussians)?;
        // Warms up.
        scene.views.iter().try_for_each(|view| ready.weights(view, regions).map(drop))?;
        loaded.push(ready);
    }
    let mut timings = vec![Vec::new(); devices.len()];
    for turn in 0..n_repeats as usize {
        let view = &scene.views[turn % scene.views.len()];
        for (device, timings) in loaded.iter().zip(&mut timings) {
            let (result, ms) = timed_ms(|| device.weights(view, regions));
            result?;
            timings.push(ms);
        }
        progress.advance(1);
    }
    let case = |((name, _), timings): (&Device, Vec<f64>)| RasterCase {
        device: name.clone(),
        n_gaussians: scene.gaussians.len(),
        width_px: camera.width_px,
        height_px: camera.height_px,
        n_regions: regions.n_regions,
        weights: Times::of(timings),
    };
    Ok(devices.iter().zip(timings).map(case).collect())
}

impl fmt::Display for RasterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n", self.machine)?;
        let mut table = Table::new(["device", "Gaussians", "median ms", "p90 ms"]);
        for case in &self.cases {
            table.row([
                case.device.clone(),
                case.n_gaussians.to_string(),
                format!("{:.2}", case.weights.median_ms),
                format!("{:.2}", case.weights.p90_ms),
            ]);
        }
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::Scene;
    use crate::generate::grammar::SceneKind;
    use slag_encoder::progress::Silent;
    use slag_encoder::raster::CpuRasterizer;

    #[test]
    fn every_device_is_measured() {
        let Scene { gaussians, mut views, .. } = Scene::new(&[SceneKind::Room], 1, 2);
        views.iter_mut().for_each(|view| view.intrinsics = view.intrinsics.scaled_to_width(64));
        let scene = BenchScene { gaussians, views };
        let devices =
            ["a", "b"].map(|name| (name.to_owned(), Box::new(CpuRasterizer) as Box<dyn Rasterizer>));
        let cases = measure(&scene, &devices, 3, &Silent).expect("rasterises");
        assert_eq!(cases.iter().map(|case| case.device.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        for case in &cases {
            assert_eq!((case.weights.n, case.n_regions), (3, 48));
            assert!(case.weights.min_ms > 0.0);
        }
    }
}
