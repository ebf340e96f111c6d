//! Masks from Segment Anything and Segment Anything 2: automatic mask generation as defined by the first's paper
//! (Kirillov et al. 2023, appendix B) and its reference implementation; prompts without an object, as the second
//! tells, give none.
//!
//! Each point of a grid is one prompt, which gives three masks: whole, part and subpart. The image encoder runs
//! once per image and crop, the decoder once per batch of points. While it decodes a batch, the masks of the
//! previous batch are enlarged and filtered in parallel.

mod filter;
mod runs;
mod upsample;

use std::panic::resume_unwind;
use std::path::Path;
use std::sync::{Arc, mpsc};

use filter::{Candidate, Filters};
pub use filter::{SamLevels, SamSettings, ScoreFilter};
use image::imageops;
use slag_models::sam::{Decoded, Sam};
use slag_models::{ModelError, SessionOptions};
use upsample::Upsampler;

use super::{MAX_MASK_BYTES, SegmentError, SegmentInput, Segmenter};
use crate::lanes::{GpuLoad, Lanes};
use crate::masks::{BoxPx, Mask};

/// While the masks of some photos are filtered, the GPU has others.
const MODELS_PER_GPU: usize = 2;

/// Concurrent photos per model: one is embedded while points of others are decoded and filtered.
const PHOTOS_PER_MODEL: usize = 3;

#[derive(Debug)]
pub struct SamSegmenter {
    lanes: Lanes<Arc<Sam>>,
    is_on_gpus: bool,
    settings: SamSettings,
    identity: String,
}

impl SamSegmenter {
    /// Opens a model directory with a `[segment]` section in `model.toml`; `gpus` share the photos if the session asks
    /// for GPUs.
    pub fn open(
        dir: &Path,
        settings: SamSettings,
        session: &SessionOptions,
        gpus: &[u32],
    ) -> Result<Self, ModelError> {
        let is_on_gpus = !session.is_on_cpu();
        let (gpus, n_models) = if is_on_gpus { (gpus, MODELS_PER_GPU) } else { (&[0][..], 1) };
        let n_points = is_on_gpus.then_some(settings.points_per_batch as usize);
        let open_on = |gpu: u32| -> Result<Vec<Arc<Sam>>, ModelError> {
            let session = SessionOptions { gpu, ..session.clone() };
            (0..n_models).map(|_| Sam::open_for(dir, &session, n_points).map(Arc::new)).collect()
        };
        // In parallel, because a GPU takes two seconds to start.
        let opened: Vec<_> = std::thread::scope(|scope| {
            let opening: Vec<_> = gpus.iter().map(|gpu| scope.spawn(|| open_on(*gpu))).collect();
            opening.into_iter().map(|one| one.join().unwrap_or_else(|panic| resume_unwind(panic))).collect()
        });
        let (mut id, mut of_gpus) = (String::new(), Vec::new());
        for (gpu, models) in gpus.iter().zip(opened) {
            let models = models?;
            models[0].id().clone_into(&mut id);
            // The first of each model, then the second.
            of_gpus.push((*gpu, models.iter().cloned().cycle().take(n_models * PHOTOS_PER_MODEL).collect()));
        }
        // The number of threads may change the order of sums in matrix products.
        let identity = format!("{id} {settings:?} on {} threads", session.intra_op_threads);
        Ok(Self { lanes: Lanes::new(of_gpus), is_on_gpus, settings, identity })
    }

    /// Masks of one crop, in pixels of the image, by list.
    fn masks_of_crop(
        &self,
        sam: &Sam,
        input: &SegmentInput<'_>,
        (crop, layer): (BoxPx, u32),
        filters: Filters<'_>,
    ) -> Result<Vec<Vec<Candidate>>, SegmentError> {
        let (width_px, height_px) = (crop.width_px(), crop.height_px());
        let cropped = imageops::crop_imm(input.image, crop.x0, crop.y0, width_px, height_px).to_image();
        let embedding = sam.embed(&cropped)?;
        let SamSettings { points_per_side, points_per_batch, crop_points_divisor, .. } = self.settings;
        let n_per_side = (points_per_side / crop_points_divisor.saturating_pow(layer)).max(1);
        let points = grid(n_per_side, width_px, height_px);
        let points: Vec<[f32; 2]> =
            points.into_iter().map(|point| embedding.letterbox.point(point)).collect();
        let labels = vec![1; points_per_batch as usize];
        let found = std::thread::scope(|scope| {
            // A rendezvous channel: at most two batches of logits are in memory, one decoded and one filtered.
            let (sender, receiver) = mpsc::sync_channel::<Decoded>(0);
            let letterbox = &embedding.letterbox;
            let filtered = scope.spawn(move || {
                let mut found = Vec::new();
                let mut left_bytes = MAX_MASK_BYTES;
                for decoded in receiver {
                    if !input.install(|| filter::is_finite(&decoded)) {
                        let advice = "run it with --provider cpu, or give another";
                        let problem = format!("the mask model's output is not finite; {advice}");
                        return Err(SegmentError::View { view: input.view.name.clone(), problem });
                    }
                    let upsampler = Upsampler::new(letterbox, decoded.logits_px);
                    let candidates = input.install(|| filters.candidates(&decoded, &upsampler, crop));
                    let len_bytes: u64 = candidates.iter().map(|candidate| candidate.mask.len_bytes()).sum();
                    left_bytes = left_bytes.checked_sub(len_bytes).ok_or_else(|| too_many(input))?;
                    found.extend(candidates);
                }
                Ok(found)
            });
            for batch in points.chunks(points_per_batch as usize) {
                let decoded = sam.decode(&embedding, batch.len(), batch, &labels[..batch.len()])?;
                if sender.send(decoded).is_err() {
                    break;
                }
            }
            drop(sender);
            filtered.join().unwrap_or_else(|panic| resume_unwind(panic))
        })?;
        let lists = filters.lists(found);
        Ok(input.install(|| lists.into_iter().map(|list| filters.unique_in_crop(list)).collect()))
    }
}

fn too_many(input: &SegmentInput<'_>) -> SegmentError {
    let advice = "lower --points-per-side, or raise --sam-predicted-iou and --sam-stability";
    let problem = format!("the masks found exceed {MAX_MASK_BYTES} bytes; {advice}");
    SegmentError::View { view: input.view.name.clone(), problem }
}

impl Segmenter for SamSegmenter {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    /// The models have their own threads.
    fn concurrency(&self) -> Option<usize> {
        Some(self.lanes.len())
    }

    fn loads(&self) -> Vec<GpuLoad> {
        if self.is_on_gpus { self.lanes.loads() } else { Vec::new() }
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let (width_px, height_px) = input.image.dimensions();
        let filters = Filters { settings: &self.settings, image_px: [width_px, height_px] };
        let crops = crops(width_px, height_px, self.settings.crop_layers, self.settings.crop_overlap);
        let mut found = vec![Vec::new(); self.settings.levels.lists().len()];
        let mut left_bytes = MAX_MASK_BYTES;
        let sam = self.lanes.take();
        for &crop in &crops {
            let of_crop = self.masks_of_crop(&sam, input, crop, filters)?;
            let len_bytes: u64 = of_crop.iter().flatten().map(|candidate| candidate.mask.len_bytes()).sum();
            left_bytes = left_bytes.checked_sub(len_bytes).ok_or_else(|| too_many(input))?;
            found.iter_mut().zip(of_crop).for_each(|(list, of_crop)| list.extend(of_crop));
        }
        drop(sam);
        let unique = |list| filters.unique_in_image(list, crops.len());
        let kept: Vec<Candidate> = input.install(|| found.into_iter().flat_map(unique).collect());
        if kept.iter().map(|candidate| candidate.mask.box_px.area_px()).sum::<u64>() > MAX_MASK_BYTES {
            return Err(too_many(input));
        }
        Ok(kept.iter().map(|candidate| candidate.mask.to_mask(candidate.level)).collect())
    }
}

/// Centres of `n_per_side` x `n_per_side` cells of an image, pixels, row by row.
pub(super) fn grid(n_per_side: u32, width_px: u32, height_px: u32) -> Vec<[f64; 2]> {
    let at = |i: u32, edge_px: u32| (f64::from(i) + 0.5) / f64::from(n_per_side) * f64::from(edge_px);
    (0..n_per_side).flat_map(|y| (0..n_per_side).map(move |x| [at(x, width_px), at(y, height_px)])).collect()
}

/// Crops with their layers: the whole image as layer 0, and 2^i x 2^i crops for each further layer `i`. They overlap by
/// `overlap_ratio` of the shorter edge in layer 1, half of that in each further layer.
pub(super) fn crops(width_px: u32, height_px: u32, n_layers: u32, overlap_ratio: f64) -> Vec<(BoxPx, u32)> {
    let mut crops = vec![(BoxPx { x0: 0, y0: 0, x1: width_px, y1: height_px }, 0)];
    for layer in 1..=n_layers {
        let n = 1_u32 << layer;
        let overlap_px = (overlap_ratio * f64::from(width_px.min(height_px)) * (2.0 / f64::from(n))) as u32;
        let len = |edge_px: u32| (overlap_px * (n - 1) + edge_px).div_ceil(n);
        let (width, height) = (len(width_px), len(height_px));
        for i in 0..n * n {
            let (x0, y0) = ((width - overlap_px) * (i / n), (height - overlap_px) * (i % n));
            let crop = BoxPx { x0, y0, x1: (x0 + width).min(width_px), y1: (y0 + height).min(height_px) };
            // In tiny images, crops at the right and bottom may be empty.
            if x0 < crop.x1 && y0 < crop.y1 {
                crops.push((crop, layer));
            }
        }
    }
    crops
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_and_crops_are_those_of_the_reference() {
        assert_eq!(grid(2, 640, 480), [[160.0, 120.0], [480.0, 120.0], [160.0, 360.0], [480.0, 360.0]]);
        assert_eq!(grid(32, 1000, 700).len(), 1024);
        // By hand: the overlap is int(512 / 1500 * 480 * 2 / 2) = 163 px, then 81 px; a crop is
        // ceil((163 + 640) / 2) = 402 px wide and ceil((163 + 480) / 2) = 322 px high, then 221 and 181 px.
        let crops = crops(640, 480, 2, 512.0 / 1500.0);
        assert_eq!(crops.len(), 1 + 4 + 16);
        let edges = |k: usize| (crops[k].1, crops[k].0.x0, crops[k].0.y0, crops[k].0.x1, crops[k].0.y1);
        assert_eq!(edges(0), (0, 0, 0, 640, 480));
        assert_eq!(
            [1, 2, 3, 4].map(edges),
            [(1, 0, 0, 402, 322), (1, 0, 159, 402, 480), (1, 239, 0, 640, 322), (1, 239, 159, 640, 480),]
        );
        assert_eq!(edges(5), (2, 0, 0, 221, 181));
        assert_eq!(edges(20), (2, 420, 300, 640, 480));
    }
}
