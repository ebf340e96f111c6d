//! `bench raster`: the time of each backend of the rasteriser for the weights of a view.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use serde::Serialize;
use slag_encoder::masks::RegionMap;
use slag_encoder::progress::Progress;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_encoder::raster::{LoadedScene, RasterError, Rasterizer, ViewWeights, WeightKind};

use super::scene::{BenchScene, cell_regions, grid_regions};
use crate::harness::{Machine, Times, timed_ms};
use crate::table::Table;

#[derive(Debug, Args)]
pub(crate) struct RasterArgs {
    /// A splat of yours, with --views [default: generated scenes].
    #[arg(long, value_name = "FILE", requires = "views")]
    scene: Option<PathBuf>,
    /// Its poses: the folder of a COLMAP model or transforms.json.
    #[arg(long, value_name = "PATH", requires = "scene")]
    views: Option<PathBuf>,
    /// Gaussians of the generated scenes [default: 100000,1000000,2000000,8000000; none with --scene].
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..))]
    gaussians: Vec<u32>,
    /// Regions of a view; a scene of yours is also measured with a grid of 8 x 6.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "8,64,512,4096",
        value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    regions: Vec<u32>,
    /// Devices to compare: cpu, gpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", value_delimiter = ',', default_value = "cpu")]
    device: Vec<DeviceChoice>,
    /// Width of views, pixels.
    #[arg(long, value_name = "PX", default_value_t = 648, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    width: u32,
    /// Height of generated views, pixels.
    #[arg(long, value_name = "PX", default_value_t = 484, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    height: u32,
    /// Timed views per case.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    repeats: u32,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

/// A backend and its name in the report.
struct Device {
    name: String,
    rasterizer: Box<dyn Rasterizer>,
}

/// Opens the devices, measures all of them on each scene, and reports.
pub(crate) fn run(args: &RasterArgs, progress: &dyn Progress) -> Result<RasterReport> {
    let threads = args.threads.map_or(0, |n| n as usize);
    rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().context("cannot start threads")?;
    let mut devices = Vec::new();
    for choice in &args.device {
        let opened = Devices::open(choice, GpuOptions::default())?;
        devices.push(Device { name: opened.names().join(", "), rasterizer: Box::new(opened) });
    }
    let sizes = match (&args.scene, args.gaussians.is_empty()) {
        (None, true) => vec![100_000, 1_000_000, 2_000_000, 8_000_000],
        _ => args.gaussians.clone(),
    };
    let n_cases = sizes.len() * args.regions.len() + args.scene.iter().count() * (args.regions.len() + 1);
    progress.begin("bench", "case", n_cases as u64, 0);
    let bench = RasterBench { n_repeats: args.repeats as usize };
    let mut report = RasterReport { machine: Machine::here(), cases: Vec::new() };
    let mut measure = |scene: &BenchScene, with_grid: bool| -> Result<()> {
        let camera = scene.views[0].intrinsics;
        let (width_px, height_px) = (camera.width_px, camera.height_px);
        let grid = with_grid.then(|| grid_regions(width_px, height_px, 8, 6));
        let cells = args.regions.iter().map(|&n| cell_regions(width_px, height_px, n));
        let maps: Vec<_> = grid.into_iter().chain(cells).collect();
        report.cases.extend(bench.run(scene, &maps, &devices, progress)?);
        Ok(())
    };
    if let (Some(scene), Some(views)) = (&args.scene, &args.views) {
        measure(&BenchScene::read(scene, views, args.width)?, true)?;
    }
    for n in sizes {
        measure(&BenchScene::generated(n as usize, args.width, args.height), false)?;
    }
    progress.end();
    Ok(report)
}

/// Settings of the benchmark.
#[derive(Clone, Copy, Debug)]
struct RasterBench {
    /// Timed views per case and device; at least 1.
    n_repeats: usize,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct RasterReport {
    machine: Machine,
    /// One per scene, region map and device.
    cases: Vec<RasterCase>,
}

/// Figures of one scene with one region map on one device; counts are means over the views.
#[derive(Clone, Debug, Serialize)]
struct RasterCase {
    scene: String,
    device: String,
    n_gaussians: usize,
    width_px: u32,
    height_px: u32,
    n_regions: u32,
    /// Gaussians that reach a pixel of the image.
    n_visible: f64,
    /// (Gaussian, tile) pairs.
    n_pairs: f64,
    n_entries: f64,
    load_ms: f64,
    /// Time of a view, one at a time.
    weights: Times,
    /// Sum of absolute differences from the first device's contributions, relative to the sum of these.
    relative_l1: f64,
}

impl RasterBench {
    /// Measures all devices on a scene, for each region map. Devices take turns view by view, so that other load
    /// on the machine affects all of them alike.
    fn run(
        &self,
        scene: &BenchScene,
        region_maps: &[RegionMap],
        devices: &[Device],
        progress: &dyn Progress,
    ) -> Result<Vec<RasterCase>, RasterError> {
        let mut loaded = Vec::with_capacity(devices.len());
        for device in devices {
            let (ready, load_ms) = timed_ms(|| device.rasterizer.load(&scene.gaussians));
            loaded.push((device.name.as_str(), load_ms, ready?));
        }
        let mut cases = Vec::new();
        for regions in region_maps {
            cases.extend(self.measure(scene, regions, &loaded)?);
            progress.advance(1);
        }
        Ok(cases)
    }

    fn measure(
        &self,
        scene: &BenchScene,
        regions: &RegionMap,
        devices: &[(&str, f64, Box<dyn LoadedScene + '_>)],
    ) -> Result<Vec<RasterCase>, RasterError> {
        let view = |turn: usize| &scene.views[turn % scene.views.len()];
        // Warms up and gives the counts.
        let mut results = Vec::with_capacity(devices.len());
        for (_, _, device) in devices {
            let views = scene.views.iter().map(|view| device.weights(view, regions, WeightKind::Blend));
            results.push(views.collect::<Result<Vec<_>, _>>()?);
        }
        let mut timings = vec![Vec::with_capacity(self.n_repeats); devices.len()];
        for turn in 0..self.n_repeats {
            for (i, (_, _, device)) in devices.iter().enumerate() {
                let (result, ms) = timed_ms(|| device.weights(view(turn), regions, WeightKind::Blend));
                result?;
                timings[i].push(ms);
            }
        }
        let mut cases = Vec::with_capacity(devices.len());
        for (i, ((name, load_ms, _), timings)) in devices.iter().zip(timings).enumerate() {
            let mean = |count: fn(&ViewWeights) -> usize| {
                results[i].iter().map(count).sum::<usize>() as f64 / scene.views.len() as f64
            };
            let weights = Times::of(timings);
            let (width_px, height_px) = (regions.width_px, regions.height_px);
            cases.push(RasterCase {
                scene: scene.name.clone(),
                device: (*name).to_owned(),
                n_gaussians: scene.gaussians.len(),
                width_px,
                height_px,
                n_regions: regions.n_regions,
                n_visible: mean(|v| v.counters.visible),
                n_pairs: mean(|v| v.counters.pairs),
                n_entries: mean(|v| v.entries.len()),
                load_ms: *load_ms,
                weights,
                relative_l1: relative_l1(&results[i], &results[0]),
            });
        }
        Ok(cases)
    }
}

/// Returns the sum of absolute differences between found and expected contributions, over all (Gaussian, region)
/// pairs of either, relative to the sum of the expected ones.
fn relative_l1(found: &[ViewWeights], expected: &[ViewWeights]) -> f64 {
    let (mut off, mut total) = (0.0, 0.0);
    for (found, expected) in found.iter().zip(expected) {
        let mut differences = BTreeMap::new();
        for entry in &expected.entries {
            differences.insert((entry.gaussian, entry.region), f64::from(entry.weight));
            total += f64::from(entry.weight);
        }
        for entry in &found.entries {
            *differences.entry((entry.gaussian, entry.region)).or_insert(0.0) -= f64::from(entry.weight);
        }
        off += differences.values().map(|d| d.abs()).sum::<f64>();
    }
    if total > 0.0 { off / total } else { 0.0 }
}

impl fmt::Display for RasterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}\n", self.machine)?;
        let columns =
            ["scene", "device", "regions", "visible", "pairs", "contributions", "median ms", "p90 ms"];
        let mut table = Table::new(columns.into_iter().chain(["rel. L1"]));
        for case in &self.cases {
            table.row([
                case.scene.clone(),
                case.device.clone(),
                case.n_regions.to_string(),
                format!("{:.0}", case.n_visible),
                format!("{:.0}", case.n_pairs),
                format!("{:.0}", case.n_entries),
                format!("{:.2}", case.weights.median_ms),
                format!("{:.2}", case.weights.p90_ms),
                format!("{:.1e}", case.relative_l1),
            ]);
        }
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::super::scene::grid_regions;
    use super::*;
    use slag_encoder::progress::Silent;
    use slag_encoder::raster::{CpuRasterizer, RegionWeight};

    #[test]
    fn every_device_is_measured_on_every_map() {
        let scene = BenchScene::generated(3000, 64, 48);
        let maps = [grid_regions(64, 48, 2, 1), grid_regions(64, 48, 4, 4)];
        let devices =
            ["a", "b"].map(|name| Device { name: name.into(), rasterizer: Box::new(CpuRasterizer) });
        let bench = RasterBench { n_repeats: 3 };
        let cases = bench.run(&scene, &maps, &devices, &Silent).unwrap();
        let of: Vec<_> = cases.iter().map(|c| (c.device.as_str(), c.n_regions)).collect();
        assert_eq!(of, [("a", 2), ("b", 2), ("a", 16), ("b", 16)]);
        for case in &cases {
            assert_eq!((case.weights.n, case.relative_l1, case.n_gaussians), (3, 0.0, 3000));
            assert!(case.n_pairs > case.n_visible && case.weights.min_ms > 0.0);
        }
    }

    #[test]
    fn differences_count_on_both_sides() {
        let of = |entries: &[(u32, f32)]| ViewWeights {
            entries: entries
                .iter()
                .map(|&(gaussian, weight)| RegionWeight { gaussian, region: 0, weight })
                .collect(),
            ..ViewWeights::default()
        };
        let found = relative_l1(&[of(&[(0, 1.0), (2, 0.5)])], &[of(&[(0, 1.25), (1, 0.75)])]);
        assert_eq!(found, (0.25 + 0.75 + 0.5) / 2.0);
    }
}
