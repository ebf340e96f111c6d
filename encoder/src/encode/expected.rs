//! What a run is expected to hold beyond what is known before the first view: the peak is planned from it.
//!
//! The number of contributions decides. A few views are rasterised beforehand, each as one region; masks divide what they
//! see, but a Gaussian seldom lies in two of them.

use slag_common::View;

use super::inputs::Inputs;
use super::settings::{EncodeSettings, MAX_RASTER_WIDTH_PX, RasterWidth};
use crate::lift::ContributionIndex;
use crate::masks::RegionMap;
use crate::memory::{MemoryPlan, Phase};
use crate::objects;
use crate::raster::{LoadedScene, RasterView};
use crate::shard;

/// One view of so many is rasterised to count its contributions, but no more than [`MAX_SAMPLES`].
const VIEWS_PER_SAMPLE: usize = 16;
const MAX_SAMPLES: usize = 6;
// Measured with the embedded models, 1 to 4 threads and 0.1 to 2.1 million Gaussians.
/// ONNX Runtime's code, as far as models use it, its environment, and what they leave behind.
const RUNTIME_BYTES: u64 = 40 << 20;
/// What a session takes beside its weights, and what the allocator keeps for each thread.
const SESSION_BYTES: u64 = 18 << 20;
/// What the processor's rasteriser takes for each Gaussian in a view's frustum, most of them hidden: projected and in tiles.
const RASTER_BYTES_PER_VISIBLE: u64 = 190;
/// And for each Gaussian that the view shows: blended.
const RASTER_BYTES_PER_ENTRY: u64 = 300;

/// Reserves what the views and their contributions are expected to take. `models`: bytes of the image model's files, if it
/// has any.
pub(super) fn reserve(
    memory: &mut MemoryPlan,
    settings: &EncodeSettings,
    inputs: &Inputs,
    (scene, views): (&dyn LoadedScene, &[&View]),
    (model_bytes, dim): (Option<u64>, usize),
) {
    let (n_threads, n_gaussians) = (settings.run.threads as u64, inputs.scene.len() as u64);
    let of_view = OfView::mean(settings, scene, views);
    let n_entries = of_view.n_entries * views.len() as u64;
    let mut expect = |phase, purpose, len_bytes| memory.reserve_expecting(phase, purpose, 0, len_bytes);
    if let Some(model_bytes) = model_bytes {
        expect(Phase::Always, "ONNX Runtime", RUNTIME_BYTES);
        expect(Phase::Views, "a model of each thread", n_threads * model_bytes);
    }
    expect(Phase::Always, "sessions and allocations of each thread", n_threads * SESSION_BYTES);
    if scene.concurrency().is_none() {
        let of_view_bytes =
            of_view.n_visible * RASTER_BYTES_PER_VISIBLE + of_view.n_entries * RASTER_BYTES_PER_ENTRY;
        expect(Phase::Views, "views that are rasterised", n_threads * of_view_bytes);
    }
    let rest_bytes = memory.rest(0).unwrap_or(0);
    let (kept_bytes, group_bytes) =
        ContributionIndex::expected_bytes(n_entries, n_gaussians, n_threads, rest_bytes);
    let mut expect = |phase, purpose, len_bytes| memory.reserve_expecting(phase, purpose, 0, len_bytes);
    for phase in [Phase::Objects, Phase::Refine, Phase::Cells] {
        expect(phase, "contributions of all views", kept_bytes);
    }
    let n_cells = (inputs.split.cells.len() as u64).min(n_threads);
    let largest_bytes = shard::largest_cell_bytes(&inputs.split, dim);
    let n_at_once = n_cells.min(rest_bytes.saturating_sub(2 * kept_bytes) / largest_bytes.max(1)).max(1);
    expect(Phase::Cells, "cells at once", n_at_once * shard::expected_bytes(largest_bytes));
    if settings.cells.objects {
        expect(Phase::Objects, "masks of superpoints", objects::expected_bytes(n_entries));
        expect(Phase::Objects, "contributions that are gone through", group_bytes);
    }
}

/// Gaussians of a view.
#[derive(Clone, Copy, Default)]
struct OfView {
    /// In its frustum.
    n_visible: u64,
    /// With a contribution.
    n_entries: u64,
}

impl OfView {
    /// Returns the means of a few views.
    fn mean(settings: &EncodeSettings, scene: &dyn LoadedScene, views: &[&View]) -> Self {
        let n_samples = (views.len() / VIEWS_PER_SAMPLE).clamp(1, MAX_SAMPLES);
        let count = |sample: usize| {
            let view = views.get((2 * sample + 1) * views.len() / (2 * n_samples))?;
            let photo_px = view.intrinsics.width_px.min(MAX_RASTER_WIDTH_PX);
            let width_px = match settings.view.raster_width {
                RasterWidth::Px(width_px) => width_px,
                RasterWidth::Twice => 2 * photo_px,
                RasterWidth::ByContent | RasterWidth::Photo => photo_px,
            };
            let intrinsics = view.intrinsics.scaled_to_width(width_px);
            let raster_view = RasterView { camera_from_world: view.camera_from_world, intrinsics };
            let [width_px, height_px] = [intrinsics.width_px, intrinsics.height_px];
            let region_of_pixel = vec![0; width_px as usize * height_px as usize];
            let whole = RegionMap { width_px, height_px, region_of_pixel, n_regions: 1 };
            // A view that cannot be rasterised is reported when its turn comes.
            let weights = scene.weights(&raster_view, &whole, settings.view.weights).ok()?;
            let n_visible = weights.counters.visible as u64;
            Some(Self { n_visible, n_entries: weights.entries.len() as u64 })
        };
        let counts: Vec<Self> = (0..n_samples).filter_map(count).collect();
        let mean = |of: fn(&Self) -> u64| counts.iter().map(of).sum::<u64>() / (counts.len() as u64).max(1);
        Self { n_visible: mean(|view| view.n_visible), n_entries: mean(|view| view.n_entries) }
    }
}
