//! One view through the stages segment, embed and raster.

use std::sync::OnceLock;

use slag_common::View;
use slag_models::{ImageEncoder, ModelDir, SessionOptions};

use super::settings::MAX_RASTER_WIDTH_PX;
use super::{EncodeError, EncodeSettings, Stopwatch};
use crate::embed;
use crate::ingest::{self, LoadedImage};
use crate::lift::ViewSums;
use crate::raster::{LoadedScene, RasterView};
use crate::segment::{self, Mask, SegmentInput, Segmenter};
use crate::shard::cells::CellSplit;

/// What every view needs.
pub(super) struct ViewWorker<'a> {
    pub(super) settings: &'a EncodeSettings,
    pub(super) scene: &'a dyn LoadedScene,
    pub(super) split: &'a CellSplit,
    pub(super) segmenter: &'a dyn Segmenter,
    pub(super) models: &'a ModelDir,
    pub(super) session: &'a SessionOptions,
    pub(super) stopwatch: &'a Stopwatch,
    /// What the image model really runs on, once it is open.
    pub(super) images_on: OnceLock<Option<String>>,
}

impl ViewWorker<'_> {
    /// Takes a view through all stages. `encoder` is the calling thread's, opened at the first need.
    pub(super) fn run(
        &self,
        view: &View,
        encoder: &mut Option<Box<dyn ImageEncoder>>,
    ) -> Result<ViewSums, EncodeError> {
        let loaded = self.stopwatch.time("decode", || ingest::load_image(view))?;
        let intrinsics = loaded.view.intrinsics;
        let raster_width_px =
            self.settings.raster_width_px.unwrap_or(intrinsics.width_px.min(MAX_RASTER_WIDTH_PX));
        let raster_view = RasterView {
            camera_from_world: view.camera_from_world,
            intrinsics: intrinsics.scaled_to_width(raster_width_px),
        };
        let mut masks = self.segment(&loaded, &raster_view)?;
        masks.retain(|mask| mask.area_px >= self.settings.min_mask_px);

        let vectors = if masks.is_empty() {
            Vec::new()
        } else {
            let encoder = match encoder {
                Some(encoder) => encoder,
                none => none.insert(self.models.image_encoder(self.session)?),
            };
            self.images_on.get_or_init(|| encoder.placement().map(ToString::to_string));
            let embedded = self.stopwatch.time("embed", || {
                embed::embed_masks(&loaded.image, &masks, encoder.as_mut(), self.settings.background, None)
            });
            embedded.map_err(|source| EncodeError::Embed { view: view.name.clone(), source })?
        };

        let size = raster_view.intrinsics;
        let (regions, masks_of_region) = segment::partition(
            &masks,
            loaded.image.width(),
            loaded.image.height(),
            size.width_px,
            size.height_px,
            loaded.valid.as_deref(),
        );
        let weights = self
            .stopwatch
            .time("raster", || self.scene.weights(&raster_view, &regions, self.settings.weights))
            .map_err(|source| EncodeError::Raster { view: view.name.clone(), source })?;
        Ok(ViewSums::new(&weights.entries, masks_of_region, vectors, self.models.dim(), self.split))
    }

    fn segment(&self, loaded: &LoadedImage, raster_view: &RasterView) -> Result<Vec<Mask>, EncodeError> {
        let depth = if self.segmenter.wants_depth() {
            let drawing = self
                .stopwatch
                .time("raster", || self.scene.draw(raster_view, [0.0; 3]))
                .map_err(|source| EncodeError::Raster { view: loaded.view.name.clone(), source })?;
            Some(enlarge(&drawing.depth, raster_view, loaded))
        } else {
            None
        };
        let input = SegmentInput::new(loaded, depth.as_deref());
        Ok(self.stopwatch.time("segment", || self.segmenter.segment(&input))?)
    }
}

/// Returns a raster's values at the photo's size, nearest.
fn enlarge(values: &[f32], raster_view: &RasterView, loaded: &LoadedImage) -> Vec<f32> {
    let (width, height) = (u64::from(loaded.image.width()), u64::from(loaded.image.height()));
    let (from_width, from_height) =
        (u64::from(raster_view.intrinsics.width_px), u64::from(raster_view.intrinsics.height_px));
    let mut out = Vec::with_capacity((width * height) as usize);
    for y in 0..height {
        let row = (2 * y + 1) * from_height / (2 * height) * from_width;
        out.extend((0..width).map(|x| values[(row + (2 * x + 1) * from_width / (2 * width)) as usize]));
    }
    out
}
