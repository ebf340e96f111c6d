//! Which devices do the work: GPUs that share the views, or the CPU.

use std::fmt;
use std::str::FromStr;
use std::sync::{Condvar, Mutex, PoisonError};

use slag_common::Gaussians;

use super::gpu::{Adapter, GpuOptions, GpuRasterizer, adapters};
use super::{
    CpuRasterizer, Drawing, LoadedScene, RasterError, RasterView, Rasterizer, StageTime, ViewWeights,
    WeightKind,
};
use crate::masks::RegionMap;

/// What the user asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DeviceChoice {
    /// All GPUs; the CPU where there is none. A GPU that the processor imitates does not count.
    #[default]
    Auto,
    /// All GPUs, or an error. An imitated one will do where there is no other.
    Gpu,
    /// The CPU.
    Cpu,
    /// One adapter, by its number in the list.
    Adapter(usize),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "gpu" => Ok(Self::Gpu),
            "cpu" => Ok(Self::Cpu),
            _ => text.parse().map(Self::Adapter).map_err(|_| {
                format!(
                    "{text:?}: expected auto, gpu, cpu or the number of an adapter (`slag-encoder devices`)"
                )
            }),
        }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Gpu => f.write_str("gpu"),
            Self::Cpu => f.write_str("cpu"),
            Self::Adapter(number) => write!(f, "{number}"),
        }
    }
}

/// No device can be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// There is none.
    #[error(
        "no GPU was found; install its Vulkan driver (Debian: libvulkan1 and the vendor's driver, or \
         mesa-vulkan-drivers), or use --device cpu"
    )]
    NoAdapter,
    /// The number is beyond the list.
    #[error("adapter {number} does not exist, there are {n_adapters}; `slag-encoder devices` lists them")]
    NoSuchAdapter {
        /// What was asked for.
        number: usize,
        /// How many there are.
        n_adapters: usize,
    },
    /// None of those asked for could be opened.
    #[error(transparent)]
    Unfit(#[from] RasterError),
}

/// The devices that do the work; a backend itself.
pub struct Devices {
    gpus: Vec<GpuRasterizer>,
    views_in_flight: usize,
}

impl Devices {
    /// Opens what was asked for. What is left out is said in the log.
    ///
    /// # Errors
    /// [`DeviceError`] unless the choice leaves the CPU.
    pub fn open(choice: DeviceChoice, options: GpuOptions) -> Result<Self, DeviceError> {
        let views_in_flight = options.views_in_flight.max(1);
        let all = if choice == DeviceChoice::Cpu { Vec::new() } else { adapters() };
        let n_adapters = all.len();
        let chosen: Vec<Adapter> = match choice {
            DeviceChoice::Cpu => Vec::new(),
            DeviceChoice::Adapter(number) => match all.into_iter().nth(number) {
                Some(adapter) => vec![adapter],
                None => return Err(DeviceError::NoSuchAdapter { number, n_adapters }),
            },
            DeviceChoice::Auto | DeviceChoice::Gpu => {
                // A GPU may be there once an interface: those of the best one's interface are distinct.
                let backend = all.first().map(|a| a.report.backend.clone());
                let (software, hardware): (Vec<Adapter>, Vec<Adapter>) = all
                    .into_iter()
                    .filter(|a| Some(&a.report.backend) == backend.as_ref())
                    .partition(|a| a.report.is_software());
                if hardware.is_empty() && choice == DeviceChoice::Gpu { software } else { hardware }
            }
        };
        let mut gpus = Vec::new();
        let mut failure = None;
        for adapter in &chosen {
            let report = &adapter.report;
            match adapter.open(report.precision) {
                Ok(device) => {
                    tracing::info!(
                        "weights on {} ({}, {}, {} GPU, projection in {:?})",
                        report.name,
                        report.backend,
                        report.driver,
                        report.kind,
                        report.precision
                    );
                    gpus.push(GpuRasterizer::new(device, options));
                }
                Err(error) => {
                    tracing::warn!("a GPU is left out: {error}");
                    failure = Some(error);
                }
            }
        }
        if gpus.is_empty() {
            match (choice, failure) {
                (DeviceChoice::Cpu, _) => {}
                (DeviceChoice::Auto, _) => tracing::info!("weights on the CPU: no GPU was found"),
                (_, Some(error)) => return Err(error.into()),
                (_, None) => return Err(DeviceError::NoAdapter),
            }
        }
        Ok(Self { gpus, views_in_flight })
    }

    /// Uses GPUs that are open already.
    pub fn of(gpus: Vec<GpuRasterizer>, views_in_flight: usize) -> Self {
        Self { gpus, views_in_flight: views_in_flight.max(1) }
    }

    /// Returns the GPUs.
    pub fn gpus(&self) -> &[GpuRasterizer] {
        &self.gpus
    }

    /// Returns the names of the devices.
    pub fn names(&self) -> Vec<String> {
        match self.gpus.is_empty() {
            true => vec!["CPU".into()],
            false => self.gpus.iter().map(|gpu| gpu.report().name.clone()).collect(),
        }
    }
}

impl Rasterizer for Devices {
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        let cpu = CpuRasterizer.load(scene)?;
        let mut gpus = Vec::new();
        for gpu in &self.gpus {
            match gpu.load(scene) {
                Ok(loaded) => gpus.push(loaded),
                Err(error @ RasterError::Device { .. }) => {
                    tracing::warn!("a GPU is left out: {error}");
                }
                Err(error) => return Err(error),
            }
        }
        if gpus.is_empty() {
            if !self.gpus.is_empty() {
                tracing::warn!("the CPU does the work of the GPUs");
            }
            return Ok(cpu);
        }
        let lanes =
            DeviceSlots { n_free: vec![self.views_in_flight; gpus.len()], is_usable: vec![true; gpus.len()] };
        Ok(Box::new(SharedScene {
            gpus,
            views_in_flight: self.views_in_flight,
            cpu,
            lanes: Mutex::new(lanes),
            freed: Condvar::new(),
        }))
    }
}

/// A scene on several GPUs. Each has as many lanes as it works on views at once; whoever asks for a
/// view gets the GPU with the most free lanes, so a slow view holds up none but its own lane.
struct SharedScene<'s> {
    gpus: Vec<Box<dyn LoadedScene + 's>>,
    views_in_flight: usize,
    cpu: Box<dyn LoadedScene + 's>,
    lanes: Mutex<DeviceSlots>,
    freed: Condvar,
}

struct DeviceSlots {
    /// Free lanes of each GPU.
    n_free: Vec<usize>,
    is_usable: Vec<bool>,
}

impl SharedScene<'_> {
    /// Returns the GPU with the most free lanes, or `None` if none is usable any more.
    fn take(&self) -> Option<usize> {
        let mut lanes = self.lanes.lock().unwrap_or_else(PoisonError::into_inner);
        while lanes.is_usable.contains(&true) {
            let usable = (0..self.gpus.len()).filter(|gpu| lanes.is_usable[*gpu] && lanes.n_free[*gpu] > 0);
            // The first of those with as many.
            if let Some(gpu) = usable.rev().max_by_key(|gpu| lanes.n_free[*gpu]) {
                lanes.n_free[gpu] -= 1;
                return Some(gpu);
            }
            lanes = self.freed.wait(lanes).unwrap_or_else(PoisonError::into_inner);
        }
        None
    }

    /// Does the work on the next free GPU; where one fails on the next, and at last on the CPU.
    fn run<T>(&self, work: impl Fn(&dyn LoadedScene) -> Result<T, RasterError>) -> Result<T, RasterError> {
        while let Some(gpu) = self.take() {
            let result = work(self.gpus[gpu].as_ref());
            let mut lanes = self.lanes.lock().unwrap_or_else(PoisonError::into_inner);
            let failed = matches!(result, Err(RasterError::Device { .. }));
            if failed && lanes.is_usable[gpu] {
                lanes.is_usable[gpu] = false;
                if let Err(error) = &result {
                    let rest = lanes.is_usable.iter().filter(|usable| **usable).count();
                    tracing::warn!("a GPU is left out: {error}; {rest} GPUs go on, else the CPU does");
                }
                // Whoever waits for a lane must see that there may be none.
                self.freed.notify_all();
            } else if !failed {
                lanes.n_free[gpu] += 1;
                self.freed.notify_one();
            }
            drop(lanes);
            match result {
                Err(RasterError::Device { .. }) => {}
                Err(error @ RasterError::DeviceRoom { .. }) => {
                    tracing::warn!("a view goes to the CPU: {error}");
                    return work(self.cpu.as_ref());
                }
                result => return result,
            }
        }
        work(self.cpu.as_ref())
    }
}

impl LoadedScene for SharedScene<'_> {
    fn weights_timed(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<(ViewWeights, Vec<StageTime>), RasterError> {
        self.run(|scene| scene.weights_timed(view, regions, kind))
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        self.run(|scene| scene.draw(view, background))
    }

    fn n_lanes(&self) -> Option<usize> {
        Some(self.gpus.len() * self.views_in_flight)
    }
}
