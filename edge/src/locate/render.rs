//! Renders the cells on board to verify the pose of a photo.

use glam::{DAffine3, DVec3};
use rayon::prelude::*;
use slag_common::appearance::Appearance;
use slag_common::shard::ShardView;
use slag_common::{Gaussians, Intrinsics};
use slag_locate::{Renderer, Rendering};
use slag_math::simd::InstructionSet;
use slag_raster::{PreparedScene, RasterView, check_view};

use crate::score::Budget;
use crate::store::Snapshot;

/// Bytes per rendered Gaussian: in the scene, on the screen, and in tiles.
const BYTES_PER_GAUSSIAN: usize = 320;
/// Bytes per Gaussian on board: its entry in the list of visible ones, which grows by doubling.
const BYTES_PER_GAUSSIAN_ON_BOARD: usize = 2 * size_of::<u32>();
/// Bytes per pixel: colour, depth and coverage, then grey and its features.
const BYTES_PER_PX: usize = 160;
/// Standard deviations within which a Gaussian may be visible.
const REACH_SIGMAS: f64 = 3.4;
/// Distance of a Gaussian's centre beside the picture, as a share of its size, besides its own reach.
const MARGIN: f64 = 0.1;

/// The cells on board with an appearance.
pub(super) struct OnBoard<'a> {
    cells: Vec<(ShardView<'a>, Appearance<'a>)>,
    budget: &'a Budget,
}

impl<'a> OnBoard<'a> {
    /// Returns the cells with an appearance, if any. Renderings are charged to the budget.
    pub(super) fn of(snapshot: &'a Snapshot, budget: &'a Budget) -> Option<Self> {
        let cells =
            snapshot.shards.iter().filter_map(|shard| Some((shard.view(), shard.additions().appearance?)));
        let cells: Vec<_> = cells.collect();
        (!cells.is_empty()).then_some(Self { cells, budget })
    }

    /// Returns the Gaussians a camera may see; `None` if over budget.
    pub(super) fn seen(&self, view: &RasterView) -> Option<Gaussians> {
        let n_on_board: usize = self.cells.iter().map(|(shard, _)| shard.header.n_gaussians as usize).sum();
        let n_px = view.intrinsics.width_px as usize * view.intrinsics.height_px as usize;
        if !self.budget.try_take(n_on_board * BYTES_PER_GAUSSIAN_ON_BOARD + n_px * BYTES_PER_PX) {
            return None;
        }
        let camera = Frustum::new(view);
        let of_cell = |(shard, appearance): &(ShardView<'_>, Appearance<'_>)| -> Vec<u32> {
            let may_see = |at: &u32| {
                let at = *at as usize;
                camera.may_see(shard.position_in_world(at), appearance.max_size(at))
            };
            (0..shard.header.n_gaussians).filter(may_see).collect()
        };
        let seen: Vec<Vec<u32>> = self.cells.par_iter().map(of_cell).collect();
        let n_seen: usize = seen.iter().map(Vec::len).sum();
        if !self.budget.try_take(n_seen * BYTES_PER_GAUSSIAN) {
            return None;
        }
        let mut scene = Gaussians::default();
        for ((shard, appearance), seen) in self.cells.iter().zip(&seen) {
            for at in seen.iter().map(|at| *at as usize) {
                appearance.add_to(&mut scene, at, shard.position_in_world(at));
            }
        }
        Some(scene)
    }
}

impl Renderer for OnBoard<'_> {
    fn render(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Option<Rendering> {
        let view = RasterView { camera_from_world: *camera_from_world, intrinsics: *intrinsics };
        check_view(&view).ok()?;
        let used_bytes = self.budget.used_bytes();
        let draw =
            |scene: Gaussians| PreparedScene::new(&scene).draw(InstructionSet::widest(), &view, [0.5; 3]);
        let drawing = self.seen(&view).map(draw);
        self.budget.give_back_to(used_bytes, 0);
        drawing.as_ref().map(Rendering::of)
    }
}

struct Frustum<'a> {
    view: &'a RasterView,
    /// Lowest and highest x / z and y / z.
    tangents: [[f64; 2]; 2],
}

impl<'a> Frustum<'a> {
    fn new(view: &'a RasterView) -> Self {
        let camera = &view.intrinsics;
        let along = |size_px: u32, centre_px: f64, focal_px: f64| {
            let size_px = f64::from(size_px);
            [-MARGIN * size_px, (1.0 + MARGIN) * size_px].map(|at| (at - centre_px) / focal_px)
        };
        let tangents = [
            along(camera.width_px, camera.centre_x_px, camera.focal_x_px),
            along(camera.height_px, camera.centre_y_px, camera.focal_y_px),
        ];
        Self { view, tangents }
    }

    /// Returns whether a Gaussian is before the camera and may reach into the picture.
    fn may_see(&self, mean_in_world: DVec3, max_size: f32) -> bool {
        let DVec3 { x, y, z } = self.view.camera_from_world.transform_point3(mean_in_world);
        let reach = REACH_SIGMAS * f64::from(max_size);
        let within = |at: f64, [low, high]: [f64; 2]| {
            let slack = |tangent: f64| reach * tangent.hypot(1.0);
            at >= low * z - slack(low) && at <= high * z + slack(high)
        };
        z > 0.0 && within(x, self.tangents[0]) && within(y, self.tangents[1])
    }
}
