//! The devices for rasterisation: GPUs that share the views, or the CPU.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use slag_common::Gaussians;

use super::cpu::CpuRasterizer;
use super::draw::Drawing;
use super::error::RasterError;
use super::gpu::{Adapter, GpuOptions, GpuRasterizer, adapters};
use super::rasterizer::{GpuSlots, LoadedScene, Rasterizer};
use super::view::RasterView;
use super::weights::{ViewWeights, WeightKind};
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

/// A backend that distributes views over several devices.
pub struct Devices {
    gpus: Vec<GpuRasterizer>,
    views_in_flight: usize,
}

impl Devices {
    /// Opens the chosen devices. Devices that fail are logged and left out.
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
                // A GPU appears once per graphics interface; within the interface of the best adapter, GPUs are
                // distinct.
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

    /// Creates a backend from opened GPUs.
    pub fn of(gpus: Vec<GpuRasterizer>, views_in_flight: usize) -> Self {
        Self { gpus, views_in_flight: views_in_flight.max(1) }
    }

    pub fn gpus(&self) -> &[GpuRasterizer] {
        &self.gpus
    }

    pub fn names(&self) -> Vec<String> {
        match self.gpus.is_empty() {
            true => vec!["CPU".into()],
            false => self.gpus.iter().map(|gpu| gpu.report().name.clone()).collect(),
        }
    }
}

impl Rasterizer for Devices {
    /// Views go to any of the GPUs: another set of kinds mixes other bits.
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
        let slots =
            DeviceSlots { n_free: vec![self.views_in_flight; gpus.len()], is_usable: vec![true; gpus.len()] };
        Ok(Box::new(SharedScene {
            gpus,
            views_in_flight: self.views_in_flight,
            cpu,
            slots: Mutex::new(slots),
            freed: Condvar::new(),
        }))
    }
}

/// A scene on several GPUs. Each GPU has one slot per view in flight. A view goes to the GPU with the most free
/// slots, so a slow view occupies only its own slot.
struct SharedScene<'s> {
    gpus: Vec<Box<dyn LoadedScene + 's>>,
    views_in_flight: usize,
    cpu: Box<dyn LoadedScene + 's>,
    slots: Mutex<DeviceSlots>,
    freed: Condvar,
}

struct DeviceSlots {
    /// Free slots of each GPU.
    n_free: Vec<usize>,
    is_usable: Vec<bool>,
}

impl<'s> SharedScene<'s> {
    fn slots(&self) -> MutexGuard<'_, DeviceSlots> {
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a slot of the GPU with the most free slots, and waits for one if necessary; `None` if no GPU is
    /// usable.
    fn take(&self) -> Option<Slot<'_, 's>> {
        let mut slots = self.slots();
        while slots.is_usable.contains(&true) {
            let usable = (0..self.gpus.len()).filter(|gpu| slots.is_usable[*gpu] && slots.n_free[*gpu] > 0);
            // The first of equals: `max_by_key` returns the last.
            if let Some(gpu) = usable.rev().max_by_key(|gpu| slots.n_free[*gpu]) {
                slots.n_free[gpu] -= 1;
                return Some(Slot { scene: self, gpu });
            }
            slots = self.freed.wait(slots).unwrap_or_else(PoisonError::into_inner);
        }
        None
    }

    /// Runs work on the next free GPU; if it fails, on another GPU, and finally on the CPU.
    fn run<T>(&self, work: impl Fn(&dyn LoadedScene) -> Result<T, RasterError>) -> Result<T, RasterError> {
        while let Some(slot) = self.take() {
            match work(self.gpus[slot.gpu].as_ref()) {
                Err(error @ RasterError::Device { .. }) => slot.give_up(&error),
                Err(error @ RasterError::DeviceCapacity { .. }) => {
                    tracing::warn!("rasterising a view on the CPU: {error}");
                    return work(self.cpu.as_ref());
                }
                result => return result,
            }
        }
        work(self.cpu.as_ref())
    }
}

/// A slot of a GPU, free again when this is dropped, whatever became of the view.
struct Slot<'a, 's> {
    scene: &'a SharedScene<'s>,
    gpu: usize,
}

impl Slot<'_, '_> {
    /// Leaves the GPU out from now on.
    fn give_up(self, error: &RasterError) {
        let mut slots = self.scene.slots();
        if std::mem::replace(&mut slots.is_usable[self.gpu], false) {
            let rest = slots.is_usable.iter().filter(|usable| **usable).count();
            tracing::warn!("ignoring a GPU: {error}; {rest} other GPUs remain");
            // Waiting threads must see that there may be no usable GPU.
            self.scene.freed.notify_all();
        }
    }
}

impl Drop for Slot<'_, '_> {
    fn drop(&mut self) {
        self.scene.slots().n_free[self.gpu] += 1;
        self.scene.freed.notify_one();
    }
}

impl LoadedScene for SharedScene<'_> {
    fn weights(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        self.run(|scene| scene.weights(view, regions, kind))
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        self.run(|scene| scene.draw(view, background))
    }

    fn gpus(&self) -> Option<GpuSlots> {
        Some(GpuSlots { n_gpus: self.gpus.len(), views_in_flight: self.views_in_flight })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With one slot, the view after one that panicked waits for ever unless the slot is given back.
    #[test]
    fn a_panic_gives_its_slot_back() {
        let gaussians = Gaussians::default();
        let cpu = || CpuRasterizer.load(&gaussians).expect("loads");
        let scene = SharedScene {
            gpus: vec![cpu()],
            views_in_flight: 1,
            cpu: cpu(),
            slots: Mutex::new(DeviceSlots { n_free: vec![1], is_usable: vec![true] }),
            freed: Condvar::new(),
        };
        let panics = || scene.run(|_| -> Result<(), RasterError> { panic!("a broken view") });
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(panics)).expect_err("it panics");
        assert_eq!(scene.slots().n_free, [1]);
        scene.run(|_| Ok(())).expect("goes on");
    }
}
