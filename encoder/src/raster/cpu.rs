//! The reference backend, on the CPU.

use slag_common::{Gaussians, Intrinsics};
use slag_math::simd::InstructionSet;
use slag_raster::{Drawing, PreparedScene, RasterView, ViewCounters, bin, check_scene, check_view};

use super::contributions::{merge, tile_contributions};
use super::rasterizer::{LoadedScene, RasterError, Rasterizer, ViewWeights};
use crate::masks::{NO_REGION, RegionMap};
use crate::memory::{MemoryPlan, Phase};

/// What a loaded scene keeps besides its Gaussians.
pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    let bytes = n_gaussians * PreparedScene::BYTES_PER_GAUSSIAN;
    memory.reserve(Phase::Views, "the size of each Gaussian", bytes as u64);
}

/// Reference backend on the current rayon pool, with the widest available instruction set.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuRasterizer;

impl Rasterizer for CpuRasterizer {
    fn identity(&self) -> String {
        "cpu".into()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(CpuScene { prepared: PreparedScene::new(scene), instructions: InstructionSet::widest() }))
    }
}

struct CpuScene<'s> {
    prepared: PreparedScene<'s>,
    instructions: InstructionSet,
}

impl LoadedScene for CpuScene<'_> {
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        let projection = self.prepared.project(view);
        let visible = &projection.visible;
        let tiles = bin(visible, &view.intrinsics);
        let by_tile = tile_contributions(visible, &tiles, regions, self.instructions);
        let entries = merge(visible, &by_tile);
        Ok(ViewWeights { entries, counters: ViewCounters::of(&projection, &tiles) })
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        check_view(view)?;
        Ok(self.prepared.draw(self.instructions, view, background))
    }
}

/// The region map must have the view's size, and no region number out of range.
pub(super) fn check_regions(regions: &RegionMap, intrinsics: &Intrinsics) -> Result<(), RasterError> {
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
