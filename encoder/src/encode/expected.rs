//! What a run is expected to hold beyond what is known before the first view: the peak is planned from it.
//!
//! The number of contributions decides. A few views are rasterised beforehand, each as one region; masks divide what they
//! see, but a Gaussian seldom lies in two of them.

use glam::DVec3;
use rayon::prelude::*;
use slag_common::View;

use super::inputs::Inputs;
use super::settings::EncodeSettings;
use crate::lift::ContributionIndex;
use crate::masks::RegionMap;
use crate::memory::{MemoryPlan, Phase};
use crate::objects;
use crate::raster::{LoadedScene, RasterView};
use crate::shard;

/// One view of so many is rasterised to count its contributions, but no more than [`MAX_SAMPLES`].
const VIEWS_PER_SAMPLE: usize = 16;
const MAX_SAMPLES: usize = 6;
/// Gaussians that are looked at for all views, to tell how far they see.
const MAX_TESTS: usize = 1 << 24;
// Measured with the embedded models, 1 to 16 threads and 0.1 to 2.1 million Gaussians.
/// ONNX Runtime's code, as far as models use it, its environment, and what they leave behind.
const RUNTIME_BYTES: u64 = 56 << 20;
/// What a session takes beside its weights, and what the allocator keeps for each thread.
const SESSION_BYTES: u64 = 4 << 20;
/// What a GPU's driver keeps in the process, and what each view takes that is with it: copies of all that goes there and back.
const DEVICE_BYTES: u64 = 140 << 20;
const DEVICE_BYTES_PER_VIEW: u64 = 10 << 20;
/// What the processor's rasteriser takes for each Gaussian in a view's frustum, most of them hidden: projected and in tiles.
const RASTER_BYTES_PER_VISIBLE: u64 = 110;
/// And for each Gaussian that the view shows: blended.
const RASTER_BYTES_PER_ENTRY: u64 = 200;

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
    let sample = Sample::of(settings, scene, views);
    let n_entries = sample.n_entries * views.len() as u64;
    let mut expect = |phase, purpose, len_bytes| memory.reserve_expecting(phase, purpose, 0, len_bytes);
    if let Some(model_bytes) = model_bytes {
        expect(Phase::Always, "ONNX Runtime", RUNTIME_BYTES);
        expect(Phase::Views, "a model of each thread", n_threads * model_bytes);
    }
    expect(Phase::Always, "sessions and allocations of each thread", n_threads * SESSION_BYTES);
    if let Some(gpus) = scene.gpus() {
        expect(Phase::Always, "drivers of GPUs", gpus.n_gpus as u64 * DEVICE_BYTES);
        expect(Phase::Views, "views on GPUs", gpus.n_views() as u64 * DEVICE_BYTES_PER_VIEW);
    } else {
        let n_visible = sample.n_visible_at_once(views, &inputs.scene.means_in_world, settings.run.threads);
        let n_entries = n_threads * sample.n_entries;
        let len_bytes = n_visible * RASTER_BYTES_PER_VISIBLE + n_entries * RASTER_BYTES_PER_ENTRY;
        expect(Phase::Views, "views that are rasterised", len_bytes);
    }
    let rest_bytes = memory.rest(0).unwrap_or(0);
    let free_for_cells_bytes = memory.rest_of(Phase::Cells);
    let (kept_bytes, group_bytes) =
        ContributionIndex::expected_bytes(n_entries, n_gaussians, n_threads, rest_bytes);
    let mut expect = |phase, purpose, len_bytes| memory.reserve_expecting(phase, purpose, 0, len_bytes);
    for phase in [Phase::Objects, Phase::Refine, Phase::Cells] {
        expect(phase, "contributions of all views", kept_bytes);
    }
    expect(Phase::Cells, "contributions that are gone through", group_bytes);
    let largest_bytes = shard::largest_cell_bytes(&inputs.split, dim);
    let n_that_fit = free_for_cells_bytes.saturating_sub(2 * kept_bytes) / largest_bytes.max(1);
    let n_at_once = n_threads.min(n_that_fit).max(1) as usize;
    let cells_bytes = shard::largest_cells_bytes(&inputs.split, dim, n_at_once);
    expect(Phase::Cells, "cells at once", shard::expected_bytes(cells_bytes));
    if settings.cells.objects {
        expect(Phase::Objects, "masks of superpoints", objects::expected_bytes(n_entries));
        expect(Phase::Objects, "contributions that are gone through", group_bytes);
    }
}

/// A few views that were rasterised.
struct Sample<'v> {
    views: Vec<&'v View>,
    /// Gaussians in the frustum of the mean one.
    n_visible: u64,
    /// Gaussians with a contribution, in the mean one.
    n_entries: u64,
}

impl<'v> Sample<'v> {
    fn of(settings: &EncodeSettings, scene: &dyn LoadedScene, views: &[&'v View]) -> Self {
        let n_samples = (views.len() / VIEWS_PER_SAMPLE).clamp(1, MAX_SAMPLES);
        let chosen = (0..n_samples).filter_map(|k| views.get((2 * k + 1) * views.len() / (2 * n_samples)));
        // A view that cannot be rasterised is reported when its turn comes.
        let counted = chosen.filter_map(|view| Some((*view, count(settings, scene, view)?)));
        let (sampled, counts): (Vec<&View>, Vec<[u64; 2]>) = counted.unzip();
        let [n_visible, n_entries] =
            [0, 1].map(|k| counts.iter().map(|counts| counts[k]).sum::<u64>() / (counts.len() as u64).max(1));
        Self { views: sampled, n_visible, n_entries }
    }

    /// Returns how many Gaussians are in the frusta of views that are worked on at the same time, at most: of `n_at_once` that
    /// follow one another. Few views see far, but these hold the most, and they lie together.
    fn n_visible_at_once(&self, views: &[&View], means_in_world: &[DVec3], n_at_once: usize) -> u64 {
        let step = (means_in_world.len() * views.len() / MAX_TESTS).max(1);
        let before = |views: &[&View]| -> Vec<u64> {
            views.par_iter().map(|view| n_before(means_in_world, step, view)).collect()
        };
        let of_sample: u64 = before(&self.views).iter().sum();
        let n_sampled = self.n_visible * self.views.len() as u64;
        let most = most_in_a_row(&before(views), n_at_once);
        (most as f64 / of_sample.max(1) as f64 * n_sampled as f64) as u64
    }
}

/// Returns the largest sum of `n` numbers that follow one another, or of all if they are fewer.
fn most_in_a_row(numbers: &[u64], n: usize) -> u64 {
    let n = n.clamp(1, numbers.len().max(1));
    numbers.windows(n).map(|numbers| numbers.iter().sum()).max().unwrap_or(0)
}

/// Rasterises a view as one region; returns how many Gaussians are visible and how many contribute.
fn count(settings: &EncodeSettings, scene: &dyn LoadedScene, view: &View) -> Option<[u64; 2]> {
    let width_px = settings.view.raster_width.px(view.intrinsics.width_px);
    let intrinsics = view.intrinsics.scaled_to_width(width_px);
    let raster_view = RasterView { camera_from_world: view.camera_from_world, intrinsics };
    let [width_px, height_px] = [intrinsics.width_px, intrinsics.height_px];
    let region_of_pixel = vec![0; width_px as usize * height_px as usize];
    let whole = RegionMap { width_px, height_px, region_of_pixel, n_regions: 1 };
    let weights = scene.weights(&raster_view, &whole, settings.view.weights).ok()?;
    Some([weights.counters.visible as u64, weights.entries.len() as u64])
}

/// Returns how many of every `step`-th mean lie before a view.
fn n_before(means_in_world: &[DVec3], step: usize, view: &View) -> u64 {
    let is_before = |mean: &&DVec3| {
        let at = view.camera_from_world.transform_point3(**mean);
        let [x_px, y_px] = view.intrinsics.pixel_from_distorted([at.x / at.z, at.y / at.z]);
        at.z > 0.0
            && (0.0..f64::from(view.intrinsics.width_px)).contains(&x_px)
            && (0.0..f64::from(view.intrinsics.height_px)).contains(&y_px)
    };
    means_in_world.iter().step_by(step).filter(is_before).count() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand.
    #[test]
    fn views_that_see_far_lie_together() {
        assert_eq!(most_in_a_row(&[1, 5, 4, 1, 7], 2), 9);
        assert_eq!(most_in_a_row(&[1, 5, 4, 1, 7], 1), 7);
        assert_eq!(most_in_a_row(&[1, 5], 16), 6);
        assert_eq!(most_in_a_row(&[], 2), 0);
    }
}
