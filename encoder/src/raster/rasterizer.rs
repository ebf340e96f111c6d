//! The interface of all backends.

use slag_common::Gaussians;
use slag_raster::{Drawing, RasterView};

use super::error::RasterError;
use super::weights::{ViewWeights, WeightKind};
use crate::masks::RegionMap;

/// The GPUs that rasterise a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpuSlots {
    pub(crate) n_gpus: usize,
    /// Views that each of them works on at once.
    pub views_in_flight: usize,
}

impl GpuSlots {
    /// Returns the number of views that all of them work on at once.
    pub fn n_views(self) -> usize {
        self.n_gpus * self.views_in_flight
    }
}

/// A backend that rasterises scenes.
pub trait Rasterizer: Send + Sync {
    /// Returns a text that differs where contributions differ in their last bits.
    fn identity(&self) -> String;

    /// Prepares a scene: validates it and, on a device with its own memory, uploads it.
    ///
    /// # Errors
    /// [`RasterError`] for an inconsistent scene. Individual unusable Gaussians are counted instead.
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError>;

    /// Rasterises one view of a scene; see [`LoadedScene::weights`].
    fn weights(
        &self,
        scene: &Gaussians,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        self.load(scene)?.weights(view, regions, kind)
    }

    /// Draws one view of a scene; see [`LoadedScene::draw`].
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
    /// Returns the contribution of each Gaussian to each region.
    ///
    /// Pixels of [`NO_REGION`](crate::masks::NO_REGION) are blended but not recorded. The same input gives the
    /// same bits for any number of threads.
    fn weights(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError>;

    /// Draws the scene over a background colour, in the colour space of its training.
    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError>;

    /// Returns the GPUs that rasterise; `None` if views are rasterised on the caller's threads.
    fn gpus(&self) -> Option<GpuSlots> {
        None
    }
}
