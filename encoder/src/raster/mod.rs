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
mod near;

use serde::Serialize;
use slag_common::Gaussians;
use slag_raster::ViewCounters;
use slag_raster::constants::NEAR_Z;

use crate::masks::RegionMap;

pub use cpu::CpuRasterizer;
pub(crate) use cpu::reserve;
pub(crate) use near::check_near_plane;
pub use slag_raster::{Drawing, InputError, RasterView, constants, pinhole};

pub trait Rasterizer: Send + Sync {
    /// Differs between rasterisers whose contributions differ in their last bits.
    fn identity(&self) -> String;

    /// Prepares a scene: validates it and, on a device with its own memory, uploads it.
    ///
    /// # Errors
    /// [`RasterError`] for an inconsistent scene. Individual unusable Gaussians are counted instead.
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError>;

    /// See [`LoadedScene::weights`].
    fn weights(
        &self,
        scene: &Gaussians,
        view: &RasterView,
        regions: &RegionMap,
    ) -> Result<ViewWeights, RasterError> {
        self.load(scene)?.weights(view, regions)
    }

    /// See [`LoadedScene::draw`].
    fn draw(
        &self,
        scene: &Gaussians,
        view: &RasterView,
        background: [f32; 3],
    ) -> Result<Drawing, RasterError> {
        self.load(scene)?.draw(view, background)
    }
}

/// A scene prepared by a backend; several threads may rasterise views at once.
pub trait LoadedScene: Send + Sync {
    /// Contribution of each Gaussian to each region. Pixels of [`NO_REGION`](crate::masks::NO_REGION) are blended but
    /// not recorded. The same input gives the same bits for any number of threads.
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError>;

    /// Draws the scene over a background colour, in the colour space of its training.
    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError>;

    /// Concurrent views on all GPUs; `None` if views are rasterised on the caller's threads.
    fn views_on_gpus(&self) -> Option<usize> {
        None
    }
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RasterError {
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(
        "the region map has {} x {} px ({found_values} values) but the view {} x {} px; \
         rasterise at the resolution of the masks",
        found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    RegionMapSize { expected_px: [u32; 2], found_px: [u32; 2], found_values: usize },
    #[error("{adapter}: {what}; use --device cpu to work without it")]
    Device { adapter: String, what: String },
    #[error("{adapter}: {what}; rasterise at a smaller width or use --device cpu")]
    DeviceCapacity { adapter: String, what: String },
    #[error(
        "pixel {pixel} has region {found}, but the map has {n_regions} regions; create the region map again"
    )]
    Region { pixel: usize, found: u32, n_regions: u32 },
    #[error(
        "the Gaussians before the cameras are {depth:.1e} units away (median), and {:.0} % nearer than {NEAR_Z}, where none \
         is drawn; enlarge poses and splat {factor} times: their positions, and the Gaussians' sizes (a PLY has logarithms of them)",
        cut_share * 100.0
    )]
    NearPlane { depth: f64, cut_share: f64, factor: f64 },
}

/// A Gaussian's contribution to a region: `alpha * T`, its part of a pixel attenuated by the Gaussians in front, summed
/// over the pixels.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
pub struct RegionWeight {
    pub gaussian: u32,
    pub region: u32,
    /// Weight, pixels; above 0.
    pub weight: f32,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewWeights {
    /// Positive, ordered by (Gaussian, region); each pair occurs once.
    pub entries: Vec<RegionWeight>,
    pub counters: ViewCounters,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Double precision, like the reference.
    F64,
    /// Single precision, for devices without `f64`. Gaussians far from the image centre, and needles, lose digits.
    F32,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    pub name: String,
    pub driver: String,
    /// Graphics interface: Vulkan, Metal, Dx12.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    pub precision: Precision,
    /// Largest buffer that a shader can access, bytes.
    pub max_binding_bytes: u64,
}

impl AdapterReport {
    /// Software adapters (llvmpipe, WARP) run on the CPU.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }
}

#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// Largest buffer, bytes; the device's own limit applies as well.
    pub max_binding_bytes: u64,
    /// Most bytes of the scene that stay on the device; the rest is uploaded for each view.
    pub max_resident_bytes: u64,
    /// Initial capacity for visible Gaussians, pairs and contributions; grows as needed.
    pub first_capacity: u32,
    /// Concurrent views, fewer if the device's memory does not suffice: while one is copied back, others compute.
    pub views_in_flight: usize,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            max_binding_bytes: u64::MAX,
            max_resident_bytes: u64::MAX,
            first_capacity: 1 << 19,
            views_in_flight: 12,
        }
    }
}
