//! The reference backend, on the CPU.

use slag_common::Gaussians;
use slag_math::simd::InstructionSet;

use super::bin::{Tiles, bin};
use super::contributions::{merge, tile_contributions};
use super::draw::{Drawing, draw};
use super::error::RasterError;
use super::project::{Prepared, Projection};
use super::rasterizer::{LoadedScene, Rasterizer};
use super::sh;
use super::validate::{check_regions, check_scene, check_view};
use super::view::RasterView;
use super::weights::{ViewCounters, ViewWeights, WeightKind};
use crate::masks::RegionMap;

/// The reference backend. It runs on the current rayon pool, with the widest instruction set available.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuRasterizer;

impl Rasterizer for CpuRasterizer {
    fn identity(&self) -> String {
        "cpu".into()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(CpuScene { prepared: Prepared::new(scene), instructions: InstructionSet::widest() }))
    }
}

/// A validated scene and the instruction set for its pixels.
struct CpuScene<'s> {
    prepared: Prepared<'s>,
    instructions: InstructionSet,
}

impl LoadedScene for CpuScene<'_> {
    fn weights(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        let projection = self.prepared.project(view);
        let visible = &projection.visible;
        let tiles = bin(visible, &view.intrinsics);
        let by_tile = tile_contributions(visible, &tiles, regions, kind, self.instructions);
        let entries = merge(visible, &by_tile);
        Ok(ViewWeights { entries, counters: counters(&projection, &tiles) })
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        check_view(view)?;
        let projection = self.prepared.project(view);
        let tiles = bin(&projection.visible, &view.intrinsics);
        let position_in_world = view.camera_from_world.inverse().translation;
        let colours = sh::colours(self.prepared.scene, &projection.visible, position_in_world);
        let mut drawing = draw(self.instructions, &projection.visible, &colours, &tiles, background);
        drawing.counters = counters(&projection, &tiles);
        Ok(drawing)
    }
}

fn counters(projection: &Projection, tiles: &Tiles) -> ViewCounters {
    ViewCounters {
        visible: projection.visible.len(),
        pairs: tiles.rows.iter().map(|row| row.n_items()).sum(),
        unusable: projection.unusable,
    }
}
