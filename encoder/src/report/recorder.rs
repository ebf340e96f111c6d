//! What a report tells beside the summary: the views and their masks, some of them drawn, the cells, and the
//! objects.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use glam::DVec3;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use slag_common::View;
use slag_common::frames::Aabb;

use crate::progress::{FoundObject, Progress};

/// Pictures of masks, evenly spread over the views.
const N_PICTURES: usize = 12;
const JPEG_QUALITY: u8 = 80;

pub(super) struct RecordedView {
    pub(super) name: String,
    pub(super) position_in_world: DVec3,
    /// Once found.
    pub(super) n_masks: Option<usize>,
    pub(super) reason: Option<String>,
    /// Masks drawn over the photo, JPEG.
    pub(super) picture: Option<Vec<u8>>,
}

#[derive(Default)]
pub(super) struct Recorded {
    /// In the order of work.
    pub(super) views: Vec<RecordedView>,
    /// Index in `views`, by name.
    place_of_view: BTreeMap<String, usize>,
    pub(super) cells: Vec<Aabb>,
    pub(super) objects: Vec<FoundObject>,
}

impl Recorded {
    fn view(&mut self, name: &str) -> Option<&mut RecordedView> {
        self.views.get_mut(*self.place_of_view.get(name)?)
    }
}

pub(crate) struct Recorder<'a> {
    shown: &'a dyn Progress,
    recorded: Mutex<Recorded>,
}

impl<'a> Recorder<'a> {
    /// `shown`: the other receiver of the progress.
    pub(crate) fn new(shown: &'a dyn Progress) -> Self {
        Self { shown, recorded: Mutex::default() }
    }

    pub(super) fn recorded(&self) -> MutexGuard<'_, Recorded> {
        self.recorded.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn has_picture(at: usize, n: usize) -> bool {
    at.is_multiple_of(n.div_ceil(N_PICTURES).max(1))
}

fn jpeg(picture: &RgbImage) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode_image(picture).ok()?;
    Some(bytes)
}

impl Progress for Recorder<'_> {
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64) {
        self.shown.begin(stage, unit, total, done);
    }

    fn advance(&self, n: u64) {
        self.shown.advance(n);
    }

    fn end(&self) {
        self.shown.end();
    }

    fn plan(&self, views: &[&View], cells: &[Aabb]) {
        let view = |view: &&View| RecordedView {
            name: view.name.clone(),
            position_in_world: view.position_in_world(),
            n_masks: None,
            reason: None,
            picture: None,
        };
        let mut recorded = self.recorded();
        recorded.views = views.iter().map(view).collect();
        recorded.place_of_view = views.iter().map(|view| view.name.clone()).zip(0..).collect();
        recorded.cells = cells.to_vec();
    }

    fn segmented(&self, view: &str, n_masks: usize, draw: &dyn Fn() -> RgbImage) {
        let mut recorded = self.recorded();
        let n_views = recorded.views.len();
        let at = recorded.place_of_view.get(view).copied();
        let Some(found) = recorded.view(view) else { return };
        found.n_masks = Some(n_masks);
        if at.is_some_and(|at| has_picture(at, n_views)) {
            // Others go on while this thread draws.
            drop(recorded);
            let picture = jpeg(&draw());
            if let Some(found) = self.recorded().view(view) {
                found.picture = picture;
            }
        }
    }

    fn left_out(&self, view: &str, reason: &str) {
        if let Some(found) = self.recorded().view(view) {
            found.reason = Some(reason.to_owned());
        }
    }

    /// Keeps the largest objects first.
    fn objects(&self, objects: &mut dyn Iterator<Item = FoundObject>) {
        let mut objects: Vec<FoundObject> = objects.collect();
        objects.sort_by(|a, b| b.n_gaussians.cmp(&a.n_gaussians).then_with(|| a.id.cmp(&b.id)));
        self.recorded().objects = objects;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: every third of 30 views has a picture, and all of 5.
    #[test]
    fn pictures_are_spread_over_the_views() {
        let of = |n: usize| (0..n).filter(|at| has_picture(*at, n)).collect::<Vec<_>>();
        assert_eq!(of(30), [0, 3, 6, 9, 12, 15, 18, 21, 24, 27]);
        assert_eq!(of(5), [0, 1, 2, 3, 4]);
        assert!(of(0).is_empty());
    }
}
