//! Progress of long work. The library itself never prints.

use glam::DVec3;
use image::RgbImage;
use slag_common::View;
use slag_common::frames::Aabb;

/// Receives the progress of one run. Stages follow one another.
pub trait Progress: Sync {
    /// Begins a stage of `total` steps, each a `unit`; an earlier run has done `done` of them.
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64);
    /// Counts `n` more steps as done.
    fn advance(&self, n: u64);
    fn end(&self);
    /// Tells what an encode is going to do: its views, and its cells.
    fn plan(&self, _views: &[&View], _cells: &[Aabb]) {}
    /// Tells that a photo has masks. `draw` draws them over the photo, reduced; it takes milliseconds, so only
    /// receivers that show the picture call it.
    fn segmented(&self, _view: &str, _n_masks: usize, _draw: &dyn Fn() -> RgbImage) {}
    fn left_out(&self, _view: &str, _reason: &str) {}
    fn objects(&self, _objects: &mut dyn Iterator<Item = FoundObject>) {}
}

#[derive(Clone, Debug, PartialEq)]
pub struct FoundObject {
    /// Its id, as answers name it.
    pub id: String,
    pub(crate) position_m: DVec3,
    pub bounds: Aabb,
    pub n_gaussians: u32,
    pub n_masks: u32,
    /// Name of the view that shows it best.
    pub photo: String,
}

pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &str, _: &str, _: u64, _: u64) {}
    fn advance(&self, _: u64) {}
    fn end(&self) {}
}
