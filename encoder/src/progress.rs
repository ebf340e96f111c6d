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
    /// Ends the stage.
    fn end(&self);
    /// Tells what an encode is going to do: its views, each with whether an earlier run has done it, and its cells.
    fn plan(&self, _views: &[(&View, bool)], _cells: &[Aabb]) {}
    /// Tells which part of the run begins.
    fn begin_phase(&self, _name: &'static str) {}
    /// Counts time that a view spent in a stage.
    fn spend(&self, _stage: &'static str, _secs: f64) {}
    /// Tells what becomes of a view.
    fn view(&self, _name: &str, _event: ViewEvent<'_>) {}
    /// Tells the things that were found.
    fn objects(&self, _objects: &mut dyn Iterator<Item = FoundObject>) {}
}

/// A thing that an encode found.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundObject {
    /// Its id, as answers name it.
    pub id: String,
    /// Where it is, world.
    pub position_m: DVec3,
    /// Its box.
    pub bounds: Aabb,
    /// Its Gaussians.
    pub n_gaussians: u32,
    /// Masks that show it.
    pub n_masks: u32,
    /// Name of the view that shows it best.
    pub photo: String,
}

/// What becomes of a view.
pub enum ViewEvent<'a> {
    /// Its photo has masks. `draw` draws them over the photo, reduced; it takes milliseconds, so it is called by receivers that
    /// show the picture alone.
    Segmented {
        /// Masks.
        n_masks: usize,
        /// Draws them.
        draw: &'a dyn Fn() -> RgbImage,
    },
    /// Its contributions are kept.
    Done,
    /// It is left out.
    LeftOut {
        /// Why.
        reason: String,
    },
}

/// Discards progress events.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &str, _: &str, _: u64, _: u64) {}
    fn advance(&self, _: u64) {}
    fn end(&self) {}
}
