//! The devices for rasterisation: GPUs that share the views, or the CPU.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};

use slag_common::Gaussians;
use slag_raster::{Drawing, RasterView};

use super::cpu::CpuRasterizer;
use super::gpu::{Adapter, GpuOptions, GpuRasterizer, adapters};
use super::{LoadedScene, RasterError, Rasterizer, ViewWeights};
use crate::lanes::Lanes;
use crate::masks::RegionMap;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// All GPUs, or the CPU if there are none. Software adapters (llvmpipe, WARP) are ignored.
    #[default]
    Auto,
    /// All GPUs, or an error. A software adapter is used if there is no other.
    Gpu,
    Cpu,
    Adapters(Vec<usize>),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "{text:?}: expected auto, gpu, cpu or numbers of adapters such as 0,1, listed by `slag-encoder devices`"
            )
        };
        match text {
            "auto" => Ok(Self::Auto),
            "gpu" => Ok(Self::Gpu),
            "cpu" => Ok(Self::Cpu),
            _ => {
                let numbers: Option<Vec<usize>> =
                    text.split(',').map(|number| number.trim().parse().ok()).collect();
                let is_distinct =
                    |numbers: &Vec<usize>| numbers.iter().collect::<BTreeSet<_>>().len() == numbers.len();
                numbers.filter(is_distinct).map(Self::Adapters).ok_or_else(wrong)
            }
        }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Gpu => f.write_str("gpu"),
            Self::Cpu => f.write_str("cpu"),
            Self::Adapters(numbers) => {
                f.write_str(&numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(","))
            }
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    #[error(
        "no GPU found; install its Vulkan driver (Debian: libvulkan1 and the vendor's driver, or \
         mesa-vulkan-drivers), or use --device cpu"
    )]
    NoAdapter,
    #[error("adapter {number} does not exist; `slag-encoder devices` lists the {n_adapters} adapters")]
    NoSuchAdapter { number: usize, n_adapters: usize },
    #[error(transparent)]
    Unfit(#[from] RasterError),
}

pub struct Devices {
    pub gpus: Vec<GpuRasterizer>,
    views_in_flight: usize,
}

impl Devices {
    /// Opens the chosen devices; those that fail are logged and left out.
    pub fn open(choice: &DeviceChoice, options: GpuOptions) -> Result<Self, DeviceError> {
        let views_in_flight = options.views_in_flight.max(1);
        let all = if *choice == DeviceChoice::Cpu { Vec::new() } else { adapters() };
        let n_adapters = all.len();
        let chosen: Vec<Adapter> = match choice {
            DeviceChoice::Cpu => Vec::new(),
            DeviceChoice::Adapters(numbers) => {
                if let Some(number) = numbers.iter().copied().find(|number| *number >= n_adapters) {
                    return Err(DeviceError::NoSuchAdapter { number, n_adapters });
                }
                let chosen = all.into_iter().enumerate().filter(|(number, _)| numbers.contains(number));
                chosen.map(|(_, adapter)| adapter).collect()
            }
            DeviceChoice::Auto | DeviceChoice::Gpu => {
                // A GPU appears once per graphics interface; within the best adapter's interface, GPUs are distinct.
                let backend = all.first().map(|a| a.report.backend.clone());
                let (software, hardware): (Vec<Adapter>, Vec<Adapter>) = all
                    .into_iter()
                    .filter(|a| Some(&a.report.backend) == backend.as_ref())
                    .partition(|a| a.report.is_software());
                if hardware.is_empty() && *choice == DeviceChoice::Gpu { software } else { hardware }
            }
        };
        let mut gpus = Vec::new();
        let mut failure = None;
        for adapter in &chosen {
            let report = &adapter.report;
            match adapter.open(report.precision) {
                Ok(device) => {
                    tracing::info!(
                        "rasterising on {} ({}, {}, {} GPU, projection in {:?})",
                        report.name,
                        report.backend,
                        report.driver,
                        report.kind,
                        report.precision
                    );
                    gpus.push(GpuRasterizer::new(device, options));
                }
                Err(error) => {
                    tracing::warn!("ignoring a GPU: {error}");
                    failure = Some(error);
                }
            }
        }
        if gpus.is_empty() {
            match (choice, failure) {
                (DeviceChoice::Cpu, _) => {}
                (DeviceChoice::Auto, _) => tracing::info!("rasterising on the CPU: no GPU found"),
                (_, Some(error)) => return Err(error.into()),
                (_, None) => return Err(DeviceError::NoAdapter),
            }
        }
        Ok(Self { gpus, views_in_flight })
    }

    pub fn of(gpus: Vec<GpuRasterizer>, views_in_flight: usize) -> Self {
        Self { gpus, views_in_flight: views_in_flight.max(1) }
    }

    pub fn names(&self) -> Vec<String> {
        match self.gpus.is_empty() {
            true => vec!["CPU".into()],
            false => self.gpus.iter().map(|gpu| gpu.report().name.clone()).collect(),
        }
    }
}

impl Rasterizer for Devices {
    /// Any GPU may take a view, so another set of kinds gives other bits.
    fn identity(&self) -> String {
        let kinds: BTreeSet<String> = self.gpus.iter().map(Rasterizer::identity).collect();
        if kinds.is_empty() { CpuRasterizer.identity() } else { Vec::from_iter(kinds).join(", ") }
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        let cpu = CpuRasterizer.load(scene)?;
        let mut gpus = Vec::new();
        for gpu in &self.gpus {
            match gpu.load(scene) {
                Ok(loaded) => gpus.push(loaded),
                Err(error @ RasterError::Device { .. }) => {
                    tracing::warn!("ignoring a GPU: {error}");
                }
                Err(error) => return Err(error),
            }
        }
        if gpus.is_empty() {
            if !self.gpus.is_empty() {
                tracing::warn!("no GPU works; rasterising on the CPU");
            }
            return Ok(cpu);
        }
        let lanes = (0..gpus.len() as u32).map(|gpu| (gpu, vec![(); self.views_in_flight]));
        let lanes = Lanes::new(lanes);
        let (views_in_flight, is_told) = (self.views_in_flight, AtomicBool::new(false));
        Ok(Box::new(SharedScene { gpus, views_in_flight, cpu, lanes, is_told }))
    }
}

/// A scene on several GPUs, each with a lane per view in flight, so a slow view occupies only its own.
struct SharedScene<'s> {
    gpus: Vec<Box<dyn LoadedScene + 's>>,
    views_in_flight: usize,
    cpu: Box<dyn LoadedScene + 's>,
    lanes: Lanes<()>,
    /// Whether the fallback to the CPU was reported.
    is_told: AtomicBool,
}

impl SharedScene<'_> {
    /// Runs work on the next free GPU; if it fails, on another, and finally on the CPU.
    fn run<T>(&self, work: impl Fn(&dyn LoadedScene) -> Result<T, RasterError>) -> Result<T, RasterError> {
        while let Some(lane) = self.lanes.take_if_any() {
            match work(self.gpus[lane.gpu() as usize].as_ref()) {
                Err(error @ RasterError::Device { .. }) => {
                    if let Some(rest) = lane.leave_out() {
                        tracing::warn!("ignoring a GPU: {error}; {rest} other GPUs remain");
                    }
                }
                Err(error @ RasterError::DeviceCapacity { .. }) => {
                    if !self.is_told.swap(true, Ordering::Relaxed) {
                        tracing::warn!("such views are rasterised on the CPU: {error}");
                    }
                    return work(self.cpu.as_ref());
                }
                result => return result,
            }
        }
        work(self.cpu.as_ref())
    }
}

impl LoadedScene for SharedScene<'_> {
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError> {
        self.run(|scene| scene.weights(view, regions))
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        self.run(|scene| scene.draw(view, background))
    }

    fn views_on_gpus(&self) -> Option<usize> {
        Some(self.gpus.len() * self.views_in_flight)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With one lane, the view after a panic would wait for ever unless the lane is given back.
    #[test]
    fn a_panic_gives_its_lane_back() {
        let gaussians = Gaussians::default();
        let cpu = || CpuRasterizer.load(&gaussians).expect("loads");
        let scene = SharedScene {
            gpus: vec![cpu()],
            views_in_flight: 1,
            cpu: cpu(),
            lanes: Lanes::new([(0, vec![()])]),
            is_told: AtomicBool::new(false),
        };
        let panics = || scene.run(|_| -> Result<(), RasterError> { panic!("a broken view") });
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(panics)).expect_err("it panics");
        scene.run(|_| Ok(())).expect("goes on");
    }
}
