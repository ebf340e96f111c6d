//! Progress of long work. The library itself never prints.

use glam::DVec3;
use image::RgbImage;
use slag_common::View;
use slag_common::frames::Aabb;

/// Receives the progress of one run; stages follow one another.
pub trait Progress: Sync {
    /// Begins a stage of `total` steps, each a `unit`; an earlier run has done `done` of them.
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64);
    /// `n` more steps are done.
    fn advance(&self, n: u64);
    fn end(&self);
    /// The views and cells of an encode, before its work.
    fn plan(&self, _views: &[&View], _cells: &[Aabb]) {}
    /// A photo has masks. `draw` draws them over the reduced photo; it takes milliseconds, so call it only for display.
    fn segmented(&self, _view: &str, _n_masks: usize, _draw: &dyn Fn() -> RgbImage) {}
    fn left_out(&self, _view: &str, _reason: &str) {}
    fn objects(&self, _objects: &mut dyn Iterator<Item = FoundObject>) {}
}

#[derive(Clone, Debug, PartialEq)]
pub struct FoundObject {
    /// As answers name it.
    pub id: String,
    pub(crate) position_m: DVec3,
    pub bounds: Aabb,
    pub n_gaussians: u32,
    pub n_masks: u32,
    /// View that shows it best.
    pub photo: String,
}

pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &str, _: &str, _: u64, _: u64) {}
    fn advance(&self, _: u64) {}
    fn end(&self) {}
}
