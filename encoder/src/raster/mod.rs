//! Stage 3: which Gaussian contributes how much to which region of a view.
//!
//! The rasteriser follows gsplat 1.5.3: EWA projection, blending front to back, the constants of
//! [`constants`]. [`CpuRasterizer`] is the reference; every backend has the same stages:
//!
//! | stage | job |
//! |---|---|
//! | [`project`] | Gaussian to screen ellipse, in `f64` relative to the camera |
//! | [`bin`] | depth order, and the Gaussians of each 16x16 tile in that order |
//! | [`blend`] | alpha and transmittance per pixel, in [`simd`] vectors |
//! | [`sums`] | sums per (Gaussian, region) |
//! | [`draw`] | colour, depth and coverage per pixel |
//! | [`sh`] | colour of a Gaussian as seen from the camera |

pub mod adapter;
pub mod bin;
pub mod blend;
pub mod buckets;
pub mod constants;
pub mod devices;
pub mod draw;
#[cfg(feature = "gpu")]
pub mod gpu;
#[cfg(not(feature = "gpu"))]
#[path = "no_gpu.rs"]
pub mod gpu;
pub mod project;
pub mod sh;
pub mod simd;
pub mod sums;

use std::time::Instant;

use glam::{DAffine3, DMat3};
use slag_common::{Distortion, Gaussians, Intrinsics};

use crate::masks::{NO_REGION, RegionMap};

pub use draw::Drawing;

/// A posed pinhole camera at raster resolution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterView {
    /// The rigid transform from world to camera (OpenCV axes).
    pub camera_from_world: DAffine3,
    /// The camera, without distortion.
    pub intrinsics: Intrinsics,
}

/// What is summed over the pixels of a region.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub enum WeightKind {
    /// `alpha * T`: what the Gaussian contributes to the picture, behind what lies in front of it.
    Blend,
    /// `exp(-d' S^-1 d / 2)` alone, as the paper prints it: no opacity, nothing in front. The
    /// footprint still ends where alpha falls below 1/255.
    Falloff,
}

/// The weight of a Gaussian summed over the pixels of a region.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
pub struct RegionWeight {
    /// Index of the Gaussian in the scene.
    pub gaussian: u32,
    /// Region of the view.
    pub region: u32,
    /// The sum, pixels; above 0.
    pub weight: f32,
}

/// What happened to the Gaussians of a scene in one view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewCounters {
    /// Gaussians whose footprint holds a pixel of the image (they may still be hidden).
    pub visible: usize,
    /// (Gaussian, tile) pairs.
    pub pairs: usize,
    /// Gaussians that cannot be drawn: not finite, not a rotation, or beyond `f32` once projected.
    pub unusable: usize,
}

/// The sparse sums of one view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewWeights {
    /// Sums above zero, ordered by (Gaussian, region), each pair once.
    pub entries: Vec<RegionWeight>,
    /// What happened on the way.
    pub counters: ViewCounters,
}

/// How long a stage of a view took.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageTime {
    /// Name of the stage.
    pub stage: &'static str,
    /// Wall time, milliseconds.
    pub ms: f64,
}

/// Why a view cannot be rasterised.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum RasterError {
    /// The columns of the scene differ in length.
    #[error("scene column {column} has {found} values, {expected} expected; read the scene again")]
    ColumnLength {
        /// Field of [`Gaussians`].
        column: &'static str,
        /// Values that the number of means asks for.
        expected: usize,
        /// Values that are there.
        found: usize,
    },
    /// More Gaussians than indices.
    #[error("scene has {found} Gaussians, {max} at most; split it into parts", max = u32::MAX)]
    SceneSize {
        /// Number of Gaussians.
        found: usize,
    },
    /// Spherical harmonics of a degree that no formula is known for.
    #[error("spherical harmonics of degree {found}, 3 at most; convert the scene")]
    ShDegree {
        /// The scene's degree.
        found: u8,
    },
    /// An image without pixels, or with too many.
    #[error(
        "image of {width_px} x {height_px} pixels, 1 to {max} in all; choose another raster width",
        max = constants::MAX_IMAGE_PX
    )]
    ImageSize {
        /// Width, pixels.
        width_px: u32,
        /// Height, pixels.
        height_px: u32,
    },
    /// A lens model.
    #[error("the camera has lens distortion; undistort the image and take its pinhole camera")]
    Distorted,
    /// Focal lengths or the principal point are not usable numbers.
    #[error(
        "focal lengths {focal_px:?} px, principal point {centre_px:?} px: not a camera; correct the intrinsics"
    )]
    Camera {
        /// Focal lengths x, y.
        focal_px: [f64; 2],
        /// Principal point x, y.
        centre_px: [f64; 2],
    },
    /// The pose is not a rotation and a finite translation.
    #[error("the pose is not rigid (off by {off:e}); correct the view's rotation")]
    Pose {
        /// Largest entry of `R'R - I`; infinite for a reflection, NaN for numbers that are not finite.
        off: f64,
    },
    /// The region map is of another image size.
    #[error(
        "region map of {found_px:?} pixels ({found_values} values), the view has {expected_px:?}; \
         rasterise at the resolution of the masks"
    )]
    RegionMapSize {
        /// Width and height of the view.
        expected_px: [u32; 2],
        /// Width and height that the map states.
        found_px: [u32; 2],
        /// Values that the map has.
        found_values: usize,
    },
    /// A GPU cannot do the work; another backend may.
    #[error("{adapter}: {what}; --device cpu works without it")]
    Device {
        /// Name of the device.
        adapter: String,
        /// What went wrong.
        what: String,
    },
    /// A view is too much for a GPU; others may not be.
    #[error("{adapter}: {what}; rasterise at a smaller width or use --device cpu")]
    DeviceRoom {
        /// Name of the device.
        adapter: String,
        /// What there is no room for.
        what: String,
    },
    /// A pixel names a region that does not exist.
    #[error("pixel {pixel} is of region {found}, the map has {n_regions}; make the region map again")]
    Region {
        /// Row-major index of the pixel.
        pixel: usize,
        /// The region it names.
        found: u32,
        /// Number of regions.
        n_regions: u32,
    },
}

/// A backend that rasterises scenes.
pub trait Rasterizer: Send + Sync {
    /// Makes a scene ready: checks it and, on a device with memory of its own, uploads it.
    ///
    /// # Errors
    /// [`RasterError`] for a scene that contradicts itself; single bad Gaussians are counted instead.
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError>;

    /// [`LoadedScene::weights`] of a scene that is needed once.
    ///
    /// # Errors
    /// [`RasterError`].
    fn weights(
        &self,
        scene: &Gaussians,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        self.load(scene)?.weights(view, regions, kind)
    }

    /// [`LoadedScene::draw`] of a scene that is needed once.
    ///
    /// # Errors
    /// [`RasterError`].
    fn draw(
        &self,
        scene: &Gaussians,
        view: &RasterView,
        background: [f32; 3],
    ) -> Result<Drawing, RasterError> {
        self.load(scene)?.draw(view, background)
    }
}

/// A scene that a backend has made ready; views may be asked for from several threads.
pub trait LoadedScene: Send + Sync {
    /// Returns the sums of each Gaussian's weight over each region; pixels of [`NO_REGION`] take
    /// light but record nothing. The same input gives the same bits for any number of threads.
    ///
    /// # Errors
    /// [`RasterError`] for input that contradicts itself, or where a device fails.
    fn weights(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        Ok(self.weights_timed(view, regions, kind)?.0)
    }

    /// [`Self::weights`] with the time of each stage in the order of the work; none where a backend
    /// does not measure them.
    ///
    /// # Errors
    /// Those of [`Self::weights`].
    fn weights_timed(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<(ViewWeights, Vec<StageTime>), RasterError>;

    /// Returns the picture of the scene over a background colour (linear in what was trained).
    ///
    /// # Errors
    /// [`RasterError`] for input that contradicts itself.
    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError>;

    /// Returns how many views devices of their own work on at once; `None` on the processor.
    fn n_lanes(&self) -> Option<usize> {
        None
    }
}

/// The reference backend; runs on the current rayon pool, with the widest instructions there are.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuRasterizer;

impl Rasterizer for CpuRasterizer {
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        CpuLevel(simd::Level::widest()).load(scene)
    }
}

/// The reference backend with a chosen instruction set; the results are the same bits.
#[derive(Clone, Copy, Debug)]
pub struct CpuLevel(pub simd::Level);

impl Rasterizer for CpuLevel {
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(CpuScene { prepared: project::Prepared::new(scene), level: self.0 }))
    }
}

/// A scene whose columns fit each other, and what its pixels are worked on with.
struct CpuScene<'s> {
    prepared: project::Prepared<'s>,
    level: simd::Level,
}

impl LoadedScene for CpuScene<'_> {
    fn weights_timed(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<(ViewWeights, Vec<StageTime>), RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        let mut times = Vec::new();
        let projection = timed("project", &mut times, || self.prepared.project(view));
        let visible = &projection.visible;
        let tiles = timed("bin", &mut times, || bin::bin(visible, &view.intrinsics));
        let sums = timed("blend", &mut times, || sums::tile_sums(visible, &tiles, regions, kind, self.level));
        let entries = timed("merge", &mut times, || sums::merge(visible, &sums));
        Ok((ViewWeights { entries, counters: counters(&projection, &tiles) }, times))
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        check_view(view)?;
        let projection = self.prepared.project(view);
        let tiles = bin::bin(&projection.visible, &view.intrinsics);
        let position_in_world = view.camera_from_world.inverse().translation;
        let colours = sh::colours(self.prepared.scene, &projection.visible, position_in_world);
        let mut drawing = draw::draw(self.level, &projection.visible, &colours, &tiles, background);
        drawing.counters = counters(&projection, &tiles);
        Ok(drawing)
    }
}

/// Does a stage's work and records its time.
fn timed<T>(stage: &'static str, times: &mut Vec<StageTime>, work: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = work();
    times.push(StageTime { stage, ms: start.elapsed().as_secs_f64() * 1e3 });
    result
}

fn counters(projection: &project::Projection, tiles: &bin::Tiles) -> ViewCounters {
    ViewCounters {
        visible: projection.visible.len(),
        pairs: tiles.rows.iter().map(|row| row.n_items()).sum(),
        unusable: projection.unusable,
    }
}

/// Checks that the columns of a scene fit each other.
fn check_scene(scene: &Gaussians) -> Result<(), RasterError> {
    let n = scene.len();
    if u32::try_from(n).is_err() {
        return Err(RasterError::SceneSize { found: n });
    }
    if scene.sh_degree > 3 {
        return Err(RasterError::ShDegree { found: scene.sh_degree });
    }
    let rest = n * Gaussians::sh_rest_per_channel(scene.sh_degree) * 3;
    for (column, found, expected) in [
        ("rotations_wxyz", scene.rotations_wxyz.len(), n),
        ("scales", scene.scales.len(), n),
        ("opacities", scene.opacities.len(), n),
        ("sh_dc", scene.sh_dc.len(), n),
        ("sh_rest", scene.sh_rest.len(), rest),
    ] {
        if found != expected {
            return Err(RasterError::ColumnLength { column, expected, found });
        }
    }
    Ok(())
}

/// Checks that a view is a rigidly posed pinhole camera with pixels.
fn check_view(view: &RasterView) -> Result<(), RasterError> {
    let Intrinsics { width_px, height_px, focal_x_px, focal_y_px, centre_x_px, centre_y_px, distortion } =
        view.intrinsics;
    if !(1..=constants::MAX_IMAGE_PX).contains(&(u64::from(width_px) * u64::from(height_px))) {
        return Err(RasterError::ImageSize { width_px, height_px });
    }
    if distortion != Distortion::None {
        return Err(RasterError::Distorted);
    }
    let is_focal = |f: f64| f.is_finite() && f > 0.0;
    if !(is_focal(focal_x_px) && is_focal(focal_y_px) && centre_x_px.is_finite() && centre_y_px.is_finite()) {
        return Err(RasterError::Camera {
            focal_px: [focal_x_px, focal_y_px],
            centre_px: [centre_x_px, centre_y_px],
        });
    }
    // Poses are often stored as f32 or rounded text; 1e-3 still is a rotation, a mirror or a scale is not.
    let rotation = view.camera_from_world.matrix3;
    let excess = rotation.transpose() * rotation - DMat3::IDENTITY;
    let off =
        excess.to_cols_array().into_iter().fold(0.0, |m: f64, e| if e.abs() <= m { m } else { e.abs() });
    if !view.camera_from_world.is_finite() {
        return Err(RasterError::Pose { off: f64::NAN });
    }
    if off > 1e-3 || rotation.determinant() < 0.0 {
        return Err(RasterError::Pose { off: if off > 1e-3 { off } else { f64::INFINITY } });
    }
    Ok(())
}

/// Checks that a region map covers the view and names regions that exist.
fn check_regions(regions: &RegionMap, intrinsics: &Intrinsics) -> Result<(), RasterError> {
    let expected_px = [intrinsics.width_px, intrinsics.height_px];
    let found_px = [regions.width_px, regions.height_px];
    let found_values = regions.region_of_pixel.len();
    if found_px != expected_px || found_values as u64 != u64::from(found_px[0]) * u64::from(found_px[1]) {
        return Err(RasterError::RegionMapSize { expected_px, found_px, found_values });
    }
    let n_regions = regions.n_regions;
    match regions.region_of_pixel.iter().position(|&r| r >= n_regions && r != NO_REGION) {
        Some(pixel) => Err(RasterError::Region { pixel, found: regions.region_of_pixel[pixel], n_regions }),
        None => Ok(()),
    }
}
