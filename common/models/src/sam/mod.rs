//! Segment Anything (Kirillov et al. 2023) and Segment Anything 2 (Ravi et al. 2024) in two ONNX files: an image
//! encoder, and a prompt encoder with the mask decoder. SAM, MobileSAM, EdgeSAM and SAM-HQ have the first layout;
//! SAM 2, SAM 2.1 and EdgeTAM the second.
//!
//! ```toml
//! name = "sam-vit-base"
//! about = "class-agnostic masks of photographs"
//! licence = "Apache-2.0"
//! files_root = "."                 # folder of the files below, relative to this file's folder
//!
//! [segment]
//! kind = "sam"                     # or "sam2": photos are stretched over the square, not padded
//! image_encoder = { path = "vision_encoder.onnx", sha256 = "..." }
//! mask_decoder = { path = "prompt_encoder_mask_decoder.onnx", sha256 = "..." }
//!                                  # weights in a file of their own: data = { path = "...onnx_data", sha256 = "..." }
//! size_px = 1024                   # this and the next two: SAM's values if left out
//! mean = [0.485, 0.456, 0.406]     # pixel value = (level / 255 - mean) / std
//! std = [0.229, 0.224, 0.225]
//! ```
//!
//! The description does not name inputs and outputs: the decoder's inputs are matched with the encoder's outputs
//! by name, points, labels and boxes by type and shape. Boxes, where a decoder takes them, are left empty. SAM 2's
//! decoder takes one prompt a call and scores the presence of an object (`object_score_logits`).

mod description;
mod names;

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use image::RgbImage;
use names::Names;
use ort::value::DynTensor;

use crate::bound::Place;
use crate::description::FILE_NAME;
use crate::model_dir::{checked, sha256_of};
use crate::placement::DeviceMemory;
use crate::preprocess::{Filter, Window, resample, values_of_levels};
use crate::session::{Model, SessionOptions, Tensor};
use crate::{Floats, ModelError};

pub use description::{SamDescription, SegmentDescription, SegmenterKind};
pub use names::MASKS_PER_PROMPT;

/// An opened SAM. Each file runs one call at a time; the two files can run in parallel.
#[derive(Debug)]
pub struct Sam {
    id: String,
    size_px: u32,
    is_stretched: bool,
    /// Pixel value for each level, per channel.
    values: [[f32; 256]; 3],
    encoder: Mutex<Model>,
    decoder: Mutex<Model>,
    names: Names,
    /// Where embeddings stay between the files: on the GPU that runs both, else with the processor.
    memory: DeviceMemory,
    /// Prompts per call of the decoder, if it was opened for a fixed number.
    prompts_per_call: Option<usize>,
}

#[derive(Debug)]
pub struct Embedding {
    /// Tensors by the name of the decoder's input.
    tensors: Vec<(String, DynTensor)>,
    pub letterbox: Letterbox,
}

impl Embedding {
    /// Tensors in the processor's memory: name of the decoder's input, shape, values.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[i64], &[f32])> {
        self.tensors.iter().filter_map(|(name, tensor)| {
            let (shape, values) = tensor.try_extract_tensor::<f32>().ok()?;
            Some((name.as_str(), &shape[..], values))
        })
    }
}

#[derive(Clone, Debug, Default)]
pub struct Decoded {
    /// The model's estimate of each mask's IoU, `[prompts][MASKS_PER_PROMPT]`.
    pub predicted_ious: Vec<f32>,
    /// Logit of each prompt that there is an object, `[prompts]`; empty for models without it.
    pub object_logits: Vec<f32>,
    /// Logits of the whole square, padding included: `[prompts][MASKS_PER_PROMPT][rows][columns]`.
    pub logits: Floats,
    /// Columns and rows of the logits.
    pub logits_px: [u32; 2],
}

impl Sam {
    /// `dir` must have a `model.toml` with `[segment]`.
    pub fn open(dir: &Path, options: &SessionOptions) -> Result<Self, ModelError> {
        Self::open_for(dir, options, None)
    }

    /// Opens `dir` with a decoder for `n_prompts` at a time, which is faster on GPUs; fewer prompts are padded.
    pub fn open_for(
        dir: &Path,
        options: &SessionOptions,
        n_prompts: Option<usize>,
    ) -> Result<Self, ModelError> {
        let path = dir.join(FILE_NAME);
        let description = SamDescription::read(&path)?;
        let files_root = dir.join(&description.files_root);
        let mut id = description.name.clone();
        let sam = &description.segment;
        for file in [&sam.image_encoder, &sam.mask_decoder] {
            for part in file.parts() {
                id = format!("{id} {}", hex::encode(sha256_of(&files_root, part)?));
            }
        }
        let mut encoder = Model::open(&checked(&files_root, &sam.image_encoder)?.into(), options)?;
        let decoder_file = checked(&files_root, &sam.mask_decoder)?.into();
        let mut decoder = Model::open(&decoder_file, options)?;
        let size_px = u32::from(sam.size_px);
        let names = Names::discover(&encoder, &decoder, i64::from(size_px))?;
        let mut prompts_per_call = None;
        if let (Some(n), Some(dimension)) = (n_prompts, decoder.dimension(&names.points, 1)) {
            decoder = Model::open_sized(&decoder_file, options, Some((&dimension, n as i64)))?;
            prompts_per_call = Some(n);
        }
        let gpu = encoder.memory.take().zip(decoder.memory.take());
        let memory = gpu.map_or_else(DeviceMemory::of_processor, |(memory, _)| memory);
        Ok(Self {
            id: format!("{id} {:?} {:?} {size_px} px", sam.mean, sam.std),
            size_px,
            is_stretched: sam.kind == SegmenterKind::Sam2,
            values: values_of_levels(sam.mean, sam.std),
            encoder: Mutex::new(encoder),
            decoder: Mutex::new(decoder),
            names,
            memory,
            prompts_per_call,
        })
    }

    /// Identity: the model's name, the hashes of its files, and its preprocessing.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Pixel values, `[3][size_px][size_px]`: resized (Pillow's bilinear) to fill the square with the longer edge
    /// or, for SAM 2, with both, normalised, and padded with zeros. `image` must have pixels.
    pub fn pixel_values(&self, image: &RgbImage) -> Vec<f32> {
        let Letterbox { resized_px: [width_px, height_px], .. } = self.letterbox_of(image);
        let whole = Window { left_px: 0, top_px: 0, width_px, height_px };
        let resized = resample(image, Filter::Bilinear, [width_px, height_px].map(u64::from), whole);
        let size = self.size_px as usize;
        let mut pixels = vec![0.0; 3 * size * size];
        for ((channel, value_of_level), plane) in
            self.values.iter().enumerate().zip(pixels.chunks_exact_mut(size * size))
        {
            let rows = resized.as_raw().chunks_exact(width_px as usize * 3);
            for (out, row) in plane.chunks_exact_mut(size).zip(rows) {
                let levels = row.iter().skip(channel).step_by(3);
                out.iter_mut().zip(levels).for_each(|(x, &level)| *x = value_of_level[usize::from(level)]);
            }
        }
        pixels
    }

    fn letterbox_of(&self, image: &RgbImage) -> Letterbox {
        let place = if self.is_stretched { Letterbox::stretched } else { Letterbox::new };
        place(self.size_px, [image.width(), image.height()])
    }

    /// `image` must have pixels.
    pub fn embed(&self, image: &RgbImage) -> Result<Embedding, ModelError> {
        let (size, pixels) = (i64::from(self.size_px), self.pixel_values(image));
        let links = &self.names.embeddings;
        let mut encoder = self.encoder.lock().unwrap_or_else(PoisonError::into_inner);
        let input = encoder.owned(vec![1, 3, size, size], pixels)?;
        let outputs: Vec<_> = links.iter().map(|link| (link.output.as_str(), Place::Device)).collect();
        let found = encoder.run_bound(&self.memory, &[(&self.names.pixels, &input)], &outputs)?;
        let inputs = links.iter().map(|link| link.input.clone());
        Ok(Embedding { tensors: inputs.zip(found).collect(), letterbox: self.letterbox_of(image) })
    }

    /// Proposes masks for prompts with the same number of points. `points`: `[n_prompts][points]`, pixels of the square
    /// ([`Letterbox::point`]). `labels` of points: 1 inside the object, 0 outside, -1 no point.
    pub fn decode(
        &self,
        embedding: &Embedding,
        n_prompts: usize,
        points: &[[f32; 2]],
        labels: &[i64],
    ) -> Result<Decoded, ModelError> {
        let mut decoder = self.decoder.lock().unwrap_or_else(PoisonError::into_inner);
        let per_call = match self.names.is_one_by_one {
            true => 1,
            false => self.prompts_per_call.unwrap_or(n_prompts).max(1),
        };
        let n_points = points.len() / n_prompts.max(1);
        let mut decoded = Decoded::default();
        let calls = points.chunks(per_call * n_points.max(1)).zip(labels.chunks(per_call * n_points.max(1)));
        for (points, labels) in calls {
            // A decoder for a fixed number of prompts gets the first ones again in place of those that are missing.
            let n = self.prompts_per_call.map_or(points.len(), |n| n * n_points);
            let padded: Vec<_> = points.iter().cycle().take(n).copied().collect();
            let labels: Vec<_> = labels.iter().cycle().take(n).copied().collect();
            let mut found = self.decode_call(&mut decoder, embedding, n_points, (&padded, &labels))?;
            if points.len() < n {
                found.truncate(points.len() / n_points.max(1));
            }
            decoded.append(found);
        }
        Ok(decoded)
    }

    /// Runs the decoder once, on prompts of `n_points` points each.
    fn decode_call(
        &self,
        decoder: &mut Model,
        embedding: &Embedding,
        n_points: usize,
        (points, labels): (&[[f32; 2]], &[i64]),
    ) -> Result<Decoded, ModelError> {
        let n = (points.len() / n_points.max(1)) as i64;
        let n_points = n_points as i64;
        let (names, n_masks) = (&self.names, MASKS_PER_PROMPT as i64);
        let (scores, masks, objects) = (&[1, n, n_masks][..], &[1, n, n_masks, -1, -1][..], &[1, n, 1][..]);
        let mut outputs = vec![(names.scores.as_str(), scores), (names.masks.as_str(), masks)];
        outputs.extend(names.objects.iter().map(|name| (name.as_str(), objects)));
        let points = decoder.owned(vec![1, n, n_points, 2], points.as_flattened().to_vec())?;
        let labels = decoder.owned(vec![1, n, n_points], labels.to_vec())?;
        let boxes = decoder.owned::<f32>(vec![1, 0, 4], Vec::new())?;
        let mut inputs = vec![(names.points.as_str(), &points), (names.labels.as_str(), &labels)];
        inputs.extend(names.boxes.iter().map(|name| (name.as_str(), &boxes)));
        inputs.extend(embedding.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor)));
        let places: Vec<_> = outputs.iter().map(|(name, _)| (*name, Place::Host)).collect();
        let mut found = decoder.run_bound(&self.memory, &inputs, &places)?.into_iter();
        let floats = |(name, shape): &(&str, &[i64])| decoder.floats(found.next(), name, shape);
        let found: Vec<Tensor> = outputs.iter().map(floats).collect::<Result<_, _>>()?;
        let mut found = found.into_iter();
        let mut next = || found.next().unwrap_or_default();
        let (scores, masks, objects) = (next(), next(), next());
        let logits_px = [masks.shape[4] as u32, masks.shape[3] as u32];
        // The upsampling needs 3; SAM's logits are never larger than the square.
        if logits_px.iter().any(|edge| !(3..=self.size_px).contains(edge)) {
            let found = format!("masks are {} x {} px", logits_px[0], logits_px[1]);
            return Err(decoder.layout_error(&found, &format!("masks of 3 to {} px a side", self.size_px)));
        }
        Ok(Decoded {
            predicted_ious: scores.values.into_vec(),
            object_logits: objects.values.into_vec(),
            logits: masks.values,
            logits_px,
        })
    }
}

impl Decoded {
    /// Keeps the output for the first `n` prompts.
    fn truncate(&mut self, n: usize) {
        let n_masks = n * MASKS_PER_PROMPT;
        self.predicted_ious.truncate(n_masks);
        self.object_logits.truncate(n);
        let mut logits = std::mem::take(&mut self.logits).into_vec();
        logits.truncate(n_masks * self.logits_px[0] as usize * self.logits_px[1] as usize);
        self.logits = logits.into();
    }

    /// Appends the output for further prompts of the same image.
    fn append(&mut self, mut more: Self) {
        self.predicted_ious.append(&mut more.predicted_ious);
        self.object_logits.append(&mut more.object_logits);
        self.logits = match self.logits.is_empty() {
            true => more.logits,
            false => {
                let mut logits = std::mem::take(&mut self.logits).into_vec();
                logits.extend_from_slice(&more.logits);
                logits.into()
            }
        };
        self.logits_px = more.logits_px;
    }
}

/// Placement of an image in the encoder's square: the longer edge fills it and the rest is padding at the right or
/// bottom (SAM), or the image is stretched over it (SAM 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Letterbox {
    pub size_px: u32,
    pub image_px: [u32; 2],
    pub resized_px: [u32; 2],
    /// Whether the image is stretched over the square; masks are then resized to the image in one step.
    pub is_stretched: bool,
}

impl Letterbox {
    /// Keeps the proportions of an image of `image_px` (width, height; neither 0) in a square of `size_px`.
    pub fn new(size_px: u32, image_px: [u32; 2]) -> Self {
        let scale = f64::from(size_px) / f64::from(image_px[0].max(image_px[1]));
        let resized_px = image_px.map(|edge| ((f64::from(edge) * scale + 0.5) as u32).max(1));
        Self { size_px, image_px, resized_px, is_stretched: false }
    }

    /// Stretches an image of `image_px` (width, height; neither 0) over a square of `size_px`.
    pub fn stretched(size_px: u32, image_px: [u32; 2]) -> Self {
        Self { size_px, image_px, resized_px: [size_px; 2], is_stretched: true }
    }

    /// Converts a point from pixels of the image to pixels of the square.
    pub fn point(&self, point_px: [f64; 2]) -> [f32; 2] {
        std::array::from_fn(|axis| {
            (point_px[axis] * (f64::from(self.resized_px[axis]) / f64::from(self.image_px[axis]))) as f32
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A decoder for two prompts runs twice, the second time padded, and gives the masks of one for any number.
    #[slag_test_support::needs_shared]
    fn a_decoder_for_two_prompts_gives_the_same_masks() {
        let options = SessionOptions::new(slag_test_support::onnx_runtime());
        let dir = tempfile::tempdir().expect("a folder");
        for file in ["vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx"] {
            let from = slag_test_support::shared("models/sam_tiny").join(file);
            fs_err::copy(from, dir.path().join(file)).expect("copies");
        }
        let description = "name = 'tiny'\nlicence = 'MIT'\n[segment]\nkind = 'sam'\n\
                           image_encoder = { path = 'vision_encoder.onnx' }\n\
                           mask_decoder = { path = 'prompt_encoder_mask_decoder.onnx' }\n";
        fs_err::write(dir.path().join(FILE_NAME), description).expect("writes");
        let sam = Sam::open(dir.path(), &options).expect("opens");
        let image = RgbImage::from_fn(90, 61, |x, y| image::Rgb([x as u8 * 2, y as u8 * 4, (x * y) as u8]));
        let decoded = |sam: &Sam| {
            let embedding = sam.embed(&image).expect("runs");
            let points = [[10.0, 20.0], [200.0, 90.0], [77.5, 31.25]].map(|at| embedding.letterbox.point(at));
            sam.decode(&embedding, 3, &points, &[1; 3]).expect("runs")
        };
        let plain = decoded(&sam);
        assert!(plain.logits.iter().any(|logit| *logit > 0.0) && plain.predicted_ious.len() == 9);
        let sam = Sam::open_for(dir.path(), &options, Some(2)).expect("opens");
        assert_eq!(sam.prompts_per_call, Some(2));
        let found = decoded(&sam);
        assert_eq!(found.logits.len(), plain.logits.len());
        let pairs = found.logits.iter().zip(&*plain.logits);
        let others = found.predicted_ious.iter().zip(&plain.predicted_ious);
        let off = pairs.chain(others).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-4, "{off}");
    }
}
