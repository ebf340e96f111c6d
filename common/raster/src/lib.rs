//! Draws Gaussians on the CPU: the stages shared by the encoder's rasteriser and the robot.
//!
//! They follow gsplat 1.5.3: EWA projection, front-to-back blending, the constants of [`constants`].
//!
//! | stage | job |
//! |---|---|
//! | `project` | Gaussian to ellipse on the screen, in `f64` relative to the camera |
//! | `bin` | depth order, and the Gaussians of each 16x16 tile in this order |
//! | `blend` | alpha and transmittance per pixel, in `simd` vectors |
//! | `draw` | colour, depth and coverage per pixel |
//! | `sh` | colour of a Gaussian seen from the camera |
#![forbid(unsafe_code)]

mod bin;
mod blend;
mod buckets;
pub mod constants;
mod draw;
mod project;
mod simd;
mod view;

pub use bin::{Tiles, bin};
pub use blend::{EXP_OF_MINUS_C, MAX_POWER, PerPixel, TileRect, WeightSink, walk_tile};
pub use buckets::{Buckets, concat};
pub use draw::{Drawing, ViewCounters, draw};
pub use project::{PreparedScene, Projection, ScreenGaussian, colour, reach2};
pub use simd::Lanes;
pub use slag_common::pinhole;
pub use view::{InputError, RasterView, check_scene, check_view};
