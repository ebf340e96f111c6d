//! The reference backend, on the CPU.

use std::time::Instant;

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
use super::weights::{StageTime, ViewCounters, ViewWeights, WeightKind};
use crate::masks::RegionMap;

/// The reference backend. It runs on the current rayon pool, with the widest instruction set available.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuRasterizer;

impl Rasterizer for CpuRasterizer {
    fn identity(&self) -> String {
        "cpu".into()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        CpuWith(InstructionSet::widest()).load(scene)
    }
}

/// The reference backend with a chosen instruction set; results have the same bits for all of them.
#[derive(Clone, Copy, Debug)]
pub struct CpuWith(pub InstructionSet);

impl Rasterizer for CpuWith {
    fn identity(&self) -> String {
        CpuRasterizer.identity()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(CpuScene { prepared: Prepared::new(scene), instructions: self.0 }))
    }
}

/// A validated scene and the instruction set for its pixels.
struct CpuScene<'s> {
    prepared: Prepared<'s>,
    instructions: InstructionSet,
}

impl LoadedScene for CpuScene<'_> {
    fn weights_and_times(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
        _: bool,
    ) -> Result<(ViewWeights, Vec<StageTime>), RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        let mut times = Vec::new();
        let projection = timed("project", &mut times, || self.prepared.project(view));
        let visible = &projection.visible;
        let tiles = timed("bin", &mut times, || bin(visible, &view.intrinsics));
        let by_tile = timed("blend", &mut times, || {
            tile_contributions(visible, &tiles, regions, kind, self.instructions)
        });
        let entries = timed("merge", &mut times, || merge(visible, &by_tile));
        Ok((ViewWeights { entries, counters: counters(&projection, &tiles) }, times))
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

/// Runs a stage and records its duration.
fn timed<T>(stage: &'static str, times: &mut Vec<StageTime>, work: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = work();
    times.push(StageTime { stage, ms: start.elapsed().as_secs_f64() * 1e3 });
    result
}

fn counters(projection: &Projection, tiles: &Tiles) -> ViewCounters {
    ViewCounters {
        visible: projection.visible.len(),
        pairs: tiles.rows.iter().map(|row| row.n_items()).sum(),
        unusable: projection.unusable,
    }
}
