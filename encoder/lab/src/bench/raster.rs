//! `bench raster`: the time of each backend of the rasteriser for the weights of a view.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Barrier, OnceLock};
use std::time::Instant;

use serde::Serialize;

use super::machine::Machine;
use super::scene::BenchScene;
use super::timing::{Spread, timed_ms};
use slag_encoder::masks::RegionMap;
use slag_encoder::progress::Progress;
use slag_encoder::raster::{LoadedScene, RasterError, Rasterizer, StageTime, ViewWeights, WeightKind};

/// A backend and its name in the report.
pub struct Device {
    /// Name.
    pub name: String,
    /// Backend.
    pub rasterizer: Box<dyn Rasterizer>,
}

/// Settings of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct RasterBench {
    /// Timed views per case and device; at least 1.
    pub n_repeats: usize,
    /// Concurrent views where throughput is measured; at least 1.
    pub n_in_flight: usize,
}

/// Figures of all cases.
#[derive(Clone, Debug, Serialize)]
pub struct RasterReport {
    /// The machine.
    pub machine: Machine,
    /// One per scene, region map and device.
    pub cases: Vec<RasterCase>,
}

/// Figures of one scene with one region map on one device; counts are means over the views.
#[derive(Clone, Debug, Serialize)]
pub struct RasterCase {
    /// Scene.
    pub scene: String,
    /// Device.
    pub device: String,
    /// Gaussians of the scene.
    pub n_gaussians: usize,
    /// Image width, pixels.
    pub width_px: u32,
    /// Image height, pixels.
    pub height_px: u32,
    /// Regions of the view.
    pub n_regions: u32,
    /// Gaussians that reach a pixel of the image.
    pub n_visible: f64,
    /// (Gaussian, tile) pairs.
    pub n_pairs: f64,
    /// Contributions returned.
    pub n_entries: f64,
    /// Time to load the scene, milliseconds.
    pub load_ms: f64,
    /// Time of a view, one at a time.
    pub weights: Spread,
    /// Gaussians of the scene over the median time.
    pub gaussians_per_sec: f64,
    /// Pairs over the median time.
    pub pairs_per_sec: f64,
    /// Pixels over the median time.
    pub pixels_per_sec: f64,
    /// Share of each stage over all repeats; empty where the device does not report stages.
    pub stages: Vec<StageShare>,
    /// Concurrent views.
    pub n_in_flight: usize,
    /// Views per second with that many concurrent views.
    pub views_per_sec: f64,
    /// Sum of absolute differences from the first device's contributions, relative to the sum of these.
    pub relative_l1: f64,
}

/// Time of a stage.
#[derive(Clone, Debug, Serialize)]
pub struct StageShare {
    /// Stage.
    pub stage: &'static str,
    /// Share of the time of all stages, 0..=1.
    pub share: f64,
    /// Mean time, milliseconds.
    pub mean_ms: f64,
}

impl RasterBench {
    /// Measures all devices on a scene, for each region map. Devices take turns view by view, so that other load on the
    /// machine affects all of them alike.
    ///
    /// # Errors
    /// [`RasterError`] of the first device that fails.
    pub fn run(
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
        let mut stages = vec![Vec::new(); devices.len()];
        for turn in 0..self.n_repeats {
            for (i, (_, _, device)) in devices.iter().enumerate() {
                let (result, ms) = timed_ms(|| device.weights_timed(view(turn), regions, WeightKind::Blend));
                stages[i].extend(result?.1);
                timings[i].push(ms);
            }
        }
        let mut cases = Vec::with_capacity(devices.len());
        for (i, ((name, load_ms, device), timings)) in devices.iter().zip(timings).enumerate() {
            let mean = |count: fn(&ViewWeights) -> usize| {
                results[i].iter().map(count).sum::<usize>() as f64 / scene.views.len() as f64
            };
            let weights = Spread::of(timings);
            let per_sec = |count: f64| count / (weights.median_ms * 1e-3);
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
                gaussians_per_sec: per_sec(scene.gaussians.len() as f64),
                pairs_per_sec: per_sec(mean(|v| v.counters.pairs)),
                pixels_per_sec: per_sec(f64::from(width_px) * f64::from(height_px)),
                weights,
                stages: shares(&stages[i], self.n_repeats),
                n_in_flight: self.n_in_flight,
                views_per_sec: self.throughput(scene, regions, device.as_ref())?,
                relative_l1: relative_l1(&results[i], &results[0]),
            });
        }
        Ok(cases)
    }

    /// Returns views per second when each of `n_in_flight` threads requests one view after another.
    fn throughput(
        &self,
        scene: &BenchScene,
        regions: &RegionMap,
        device: &dyn LoadedScene,
    ) -> Result<f64, RasterError> {
        let n_views = self.n_repeats.max(self.n_in_flight);
        let next = AtomicUsize::new(0);
        let warm = Barrier::new(self.n_in_flight);
        let started = OnceLock::new();
        let ask = || {
            let view = |turn: usize| &scene.views[turn % scene.views.len()];
            // A device allocates buffers for concurrent views on first use.
            let first = device.weights(view(0), regions, WeightKind::Blend);
            warm.wait();
            first?;
            started.get_or_init(Instant::now);
            loop {
                let turn = next.fetch_add(1, Ordering::Relaxed);
                if turn >= n_views {
                    return Ok(());
                }
                device.weights(view(turn), regions, WeightKind::Blend)?;
            }
        };
        let outcome = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..self.n_in_flight).map(|_| scope.spawn(ask)).collect();
            threads.into_iter().map(|thread| thread.join()).collect::<Vec<_>>()
        });
        let ms = started.get().map_or(f64::NAN, |start: &Instant| start.elapsed().as_secs_f64() * 1e3);
        for result in outcome {
            result.unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        }
        Ok(n_views as f64 / (ms * 1e-3))
    }
}

/// Sums up the stages of all repeats, in order of first occurrence.
fn shares(times: &[StageTime], n_repeats: usize) -> Vec<StageShare> {
    let mut stages: Vec<StageShare> = Vec::new();
    let total: f64 = times.iter().map(|time| time.ms).sum();
    for time in times {
        let at = stages.iter().position(|s| s.stage == time.stage).unwrap_or_else(|| {
            stages.push(StageShare { stage: time.stage, share: 0.0, mean_ms: 0.0 });
            stages.len() - 1
        });
        stages[at].share += time.ms / total;
        stages[at].mean_ms += time.ms / n_repeats as f64;
    }
    stages
}

/// Returns the sum of absolute differences between found and expected contributions, over all (Gaussian, region) pairs of
/// either, relative to the sum of the expected ones.
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
        let Machine { cpu, n_threads, platform, .. } = &self.machine;
        writeln!(f, "{cpu}, {n_threads} threads, {platform}")?;
        writeln!(
            f,
            "{:<22} {:<8} {:>8} {:>9} {:>9} {:>9} {:>9} {:>9} {:>8} {:>8}  stages",
            "scene",
            "device",
            "regions",
            "visible",
            "pairs",
            "contributions",
            "median ms",
            "p90 ms",
            "views/s",
            "rel. L1"
        )?;
        for case in &self.cases {
            write!(
                f,
                "{:<22} {:<8} {:>8} {:>9.0} {:>9.0} {:>9.0} {:>9.2} {:>9.2} {:>8.1} {:>8.1e} ",
                case.scene,
                case.device,
                case.n_regions,
                case.n_visible,
                case.n_pairs,
                case.n_entries,
                case.weights.median_ms,
                case.weights.p90_ms,
                case.views_per_sec,
                case.relative_l1
            )?;
            for stage in &case.stages {
                write!(f, " {} {:.0} %", stage.stage, stage.share * 100.0)?;
            }
            writeln!(f)?;
        }
        Ok(())
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
        let bench = RasterBench { n_repeats: 3, n_in_flight: 2 };
        let cases = bench.run(&scene, &maps, &devices, &Silent).unwrap();
        let of: Vec<_> = cases.iter().map(|c| (c.device.as_str(), c.n_regions)).collect();
        assert_eq!(of, [("a", 2), ("b", 2), ("a", 16), ("b", 16)]);
        for case in &cases {
            assert_eq!((case.weights.n, case.relative_l1, case.n_gaussians), (3, 0.0, 3000));
            let stages: Vec<_> = case.stages.iter().map(|s| s.stage).collect();
            assert_eq!(stages, ["project", "bin", "blend", "merge"]);
            assert!((case.stages.iter().map(|s| s.share).sum::<f64>() - 1.0).abs() < 1e-9);
            let whole: f64 = case.stages.iter().map(|s| s.mean_ms).sum();
            assert!(
                whole <= case.weights.max_ms && case.n_pairs > case.n_visible && case.views_per_sec > 0.0
            );
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
