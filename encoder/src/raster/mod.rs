//! Rasterisation: the contribution of each Gaussian to each region of a view.
//!
//! The rasteriser follows gsplat 1.5.3: EWA projection, front-to-back blending, the constants of [`constants`].
//! [`CpuRasterizer`] is the reference. Every backend has the same stages:
//!
//! | stage | job |
//! |---|---|
//! | `project` | Gaussian to ellipse on the screen, in `f64` relative to the camera |
//! | `bin` | depth order, and the Gaussians of each 16x16 tile in this order |
//! | `blend` | alpha and transmittance per pixel, in `simd` vectors |
//! | `contributions` | weights summed per (Gaussian, region) |
//! | `draw` | colour, depth and coverage per pixel |
//! | `sh` | colour of a Gaussian seen from the camera |

mod adapter;
mod bin;
mod blend;
mod buckets;
pub mod constants;
mod contributions;
mod cpu;
pub mod devices;
mod draw;
mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(not(feature = "gpu"))]
#[path = "no_gpu.rs"]
pub mod gpu;
mod project;
mod rasterizer;
mod sh;
mod simd;
mod validate;
mod view;
mod weights;

pub use cpu::CpuRasterizer;
pub use draw::Drawing;
pub use error::RasterError;
pub(crate) use project::Prepared as PreparedScene;
pub(crate) use rasterizer::GpuSlots;
pub use rasterizer::{LoadedScene, Rasterizer};
pub use view::{RasterView, pinhole};
pub use weights::{RegionWeight, ViewWeights, WeightKind};
