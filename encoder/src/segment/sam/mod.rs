//! Masks from Segment Anything: automatic mask generation as its paper (Kirillov et al. 2023, appendix B) and its
//! reference implementation define it.
//!
//! Each point of a grid is a prompt of its own; each gives three masks: the whole thing, a part, a subpart. The
//! image encoder runs once an image (and crop), the decoder a batch of points at a time; while it works on the next
//! batch, the masks of the last one are enlarged and filtered in parallel.

mod filter;
mod points;
mod runs;
#[cfg(test)]
mod tests;
mod upsample;

use std::path::Path;
use std::sync::mpsc;

use image::imageops;
use slag_models::sam::{Decoded, Sam};
use slag_models::{ModelError, SessionOptions};

use super::error::SegmentError;
use super::segmenter::{MAX_MASK_BYTES, SegmentInput, Segmenter};
use crate::masks::{BoxPx, Mask};
use filter::{Candidate, Filters};
use upsample::Upsampler;

/// How many masks are asked for and which are kept. The defaults are those of the reference implementation.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SamSettings {
    /// Points along each side of the grid.
    pub points_per_side: u32,
    /// Points that the decoder takes at once; its memory grows with it: 0.8 MB a point, twice.
    pub points_per_batch: u32,
    /// The model's guess of a mask's IoU must be above this; 0 lets all pass.
    pub predicted_iou: f32,
    /// IoU that a mask cut at logits of `stability_offset` above 0 and below must have.
    pub stability: f64,
    /// Logits.
    pub stability_offset: f32,
    /// Of two masks of a crop whose boxes have an IoU above this, the one of better predicted IoU stays.
    pub box_nms_iou: f64,
    /// The same for the pixels of all masks at the end; 1 compares none, as the reference implementation.
    pub mask_nms_iou: f64,
    /// Layers of crops beside the whole image; layer `i` has 4^i of them.
    pub crop_layers: u32,
    /// Of two masks of different crops whose boxes have an IoU above this, the one of the smaller crop stays.
    pub crop_nms_iou: f64,
    /// Overlap of neighbouring crops of the first layer, relative to the shorter edge of the image.
    pub crop_overlap: f64,
    /// From layer to layer, points along a side are divided by this.
    pub crop_points_divisor: u32,
    /// Holes and islands of fewer pixels are healed; 0 heals none.
    pub min_region_px: u32,
}

impl Default for SamSettings {
    fn default() -> Self {
        Self {
            points_per_side: 32,
            points_per_batch: 64,
            predicted_iou: 0.88,
            stability: 0.95,
            stability_offset: 1.0,
            box_nms_iou: 0.7,
            mask_nms_iou: 1.0,
            crop_layers: 0,
            crop_nms_iou: 0.7,
            crop_overlap: 512.0 / 1500.0,
            crop_points_divisor: 1,
            min_region_px: 0,
        }
    }
}

/// Finds masks with SAM.
#[derive(Debug)]
pub struct SamSegmenter {
    sam: Sam,
    settings: SamSettings,
    identity: String,
}

impl SamSegmenter {
    /// Opens a model directory whose `model.toml` has `[segment]`.
    ///
    /// # Errors
    /// [`ModelError`] where a file is absent or not as described, or ONNX Runtime does not load.
    pub fn open(dir: &Path, settings: SamSettings, session: &SessionOptions) -> Result<Self, ModelError> {
        let sam = Sam::open(dir, session)?;
        // Sums of matrix products may be split by the threads of a run.
        let identity = format!("{} {settings:?} on {} threads", sam.id(), session.intra_op_threads);
        Ok(Self { sam, settings, identity })
    }

    /// Returns the masks of one crop, boxes and pixels those of the image.
    fn masks_of_crop(
        &self,
        input: &SegmentInput<'_>,
        (crop, layer): (BoxPx, u32),
        filters: Filters<'_>,
    ) -> Result<Vec<Candidate>, SegmentError> {
        let (width_px, height_px) = (crop.width_px(), crop.height_px());
        let cropped = imageops::crop_imm(input.image, crop.x0, crop.y0, width_px, height_px).to_image();
        let embedding = self.sam.embed(&cropped)?;
        let SamSettings { points_per_side, points_per_batch, crop_points_divisor, .. } = self.settings;
        let n_per_side = (points_per_side / crop_points_divisor.saturating_pow(layer)).max(1);
        let points = points::grid(n_per_side, width_px, height_px);
        let points: Vec<[f32; 2]> = points.into_iter().map(|point| embedding.frame.point(point)).collect();
        let labels = vec![1; points_per_batch as usize];
        let found = std::thread::scope(|scope| {
            // Of no capacity: two batches of logits at a time, one decoded and one filtered.
            let (sender, receiver) = mpsc::sync_channel::<Decoded>(0);
            let frame = &embedding.frame;
            let filtered = scope.spawn(move || {
                let mut found = Vec::new();
                let mut left_bytes = MAX_MASK_BYTES;
                for decoded in receiver {
                    let upsampler = Upsampler::new(frame, decoded.logits_px);
                    let candidates = filters.candidates(&decoded, &upsampler, crop);
                    let len_bytes: u64 = candidates.iter().map(|candidate| candidate.mask.len_bytes()).sum();
                    left_bytes = left_bytes.checked_sub(len_bytes)?;
                    found.extend(candidates);
                }
                Some(found)
            });
            for batch in points.chunks(points_per_batch as usize) {
                let decoded = self.sam.decode(&embedding, batch.len(), batch, &labels[..batch.len()])?;
                if sender.send(decoded).is_err() {
                    break;
                }
            }
            drop(sender);
            Ok::<_, SegmentError>(filtered.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })?;
        Ok(filters.unique_in_crop(found.ok_or_else(|| too_many(input))?))
    }
}

fn too_many(input: &SegmentInput<'_>) -> SegmentError {
    SegmentError::TooManyMasks { view: input.view.name.clone(), limit_bytes: MAX_MASK_BYTES }
}

impl Segmenter for SamSegmenter {
    fn identity(&self) -> Result<String, SegmentError> {
        Ok(self.identity.clone())
    }

    /// One image is embedded while another's points are decoded; the model has threads of its own.
    fn concurrency(&self) -> Option<usize> {
        Some(2)
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let (width_px, height_px) = input.image.dimensions();
        let filters = Filters { settings: &self.settings, image_px: [width_px, height_px] };
        let crops = points::crops(width_px, height_px, self.settings.crop_layers, self.settings.crop_overlap);
        let mut found = Vec::new();
        let mut left_bytes = MAX_MASK_BYTES;
        for &crop in &crops {
            let of_crop = self.masks_of_crop(input, crop, filters)?;
            let len_bytes: u64 = of_crop.iter().map(|candidate| candidate.mask.len_bytes()).sum();
            left_bytes = left_bytes.checked_sub(len_bytes).ok_or_else(|| too_many(input))?;
            found.extend(of_crop);
        }
        let kept = filters.unique_in_image(found, crops.len());
        let area = |b: BoxPx| u64::from(b.width_px()) * u64::from(b.height_px());
        if kept.iter().map(|candidate| area(candidate.mask.box_px())).sum::<u64>() > MAX_MASK_BYTES {
            return Err(too_many(input));
        }
        Ok(kept.iter().map(|candidate| candidate.mask.to_mask(candidate.level)).collect())
    }
}
