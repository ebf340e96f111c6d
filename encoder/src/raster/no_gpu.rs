//! Stands in for the GPU backend in builds without the feature `gpu`: no adapter is found.

use std::convert::Infallible;

use slag_common::Gaussians;

pub(crate) use super::AdapterReport;
pub use super::{GpuOptions, Precision};
use super::{LoadedScene, RasterError, Rasterizer};

pub struct Adapter {
    pub report: AdapterReport,
    none: Infallible,
}

pub struct Device {
    none: Infallible,
}

/// The GPU backend, which cannot be made.
pub struct GpuRasterizer {
    none: Infallible,
}

pub fn adapters() -> Vec<Adapter> {
    Vec::new()
}

impl Adapter {
    pub fn open(&self, _: Precision) -> Result<Device, RasterError> {
        match self.none {}
    }
}

impl GpuRasterizer {
    pub fn new(device: Device, _: GpuOptions) -> Self {
        match device.none {}
    }

    pub fn report(&self) -> &AdapterReport {
        match self.none {}
    }
}

impl Rasterizer for GpuRasterizer {
    fn identity(&self) -> String {
        match self.none {}
    }

    fn load<'s>(&self, _: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        match self.none {}
    }
}
