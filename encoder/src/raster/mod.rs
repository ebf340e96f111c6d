//! Rasterisation: the contribution of each Gaussian to each region of a view.
//!
//! [`CpuRasterizer`] is the reference; its stages up to blending are [`slag_raster`]'s. On GPUs every stage is a
//! shader. `contributions` sums weights per (Gaussian, region).

mod cpu;
pub mod devices;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(not(feature = "gpu"))]
#[path = "no_gpu.rs"]
pub mod gpu;
mod rasterizer;

pub use cpu::CpuRasterizer;
pub(crate) use cpu::reserve;
pub(crate) use rasterizer::GpuSlots;
pub use rasterizer::{LoadedScene, RasterError, Rasterizer, RegionWeight, ViewWeights};
pub use slag_raster::{Drawing, InputError, RasterView, constants, pinhole};
