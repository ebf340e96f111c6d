//! Segment Anything (Kirillov et al. 2023) in two ONNX files: an image encoder, and a prompt encoder with the
//! mask decoder. SAM, MobileSAM, EdgeSAM and SAM-HQ are exported so.
//!
//! ```toml
//! name = "sam-vit-base"
//! about = "class-agnostic masks of photographs"
//! licence = "Apache-2.0"
//! files_root = "."                 # folder of the files below, relative to this file's folder
//!
//! [segment]
//! kind = "sam"
//! image_encoder = { path = "vision_encoder.onnx", sha256 = "..." }
//! mask_decoder = { path = "prompt_encoder_mask_decoder.onnx", sha256 = "..." }
//! size_px = 1024                   # these three may be left out: SAM's own
//! mean = [0.485, 0.456, 0.406]     # pixel value = (level / 255 - mean) / std
//! std = [0.229, 0.224, 0.225]
//! ```
//!
//! Names of inputs and outputs are not described but discovered: an input takes the output of the same name,
//! points and labels are known by type and shape.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use image::RgbImage;
use ort::value::TensorElementType;
use serde::Deserialize;

use crate::ModelError;
use crate::description::{DescriptionError, FILE_NAME, FileRef, check_common, read_toml, require};
use crate::model_dir::{checked, sha256_of};
use crate::preprocess::{Filter, Window, resample, values_of_levels};
use crate::session::{Model, SessionError, SessionOptions, Tensor};

/// Masks that SAM proposes for a prompt: subpart, part and whole, in this order.
pub const MASKS_PER_PROMPT: usize = 3;

/// The description of a segmenter's directory.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamDescription {
    /// The model's name.
    pub name: String,
    /// What it is good for and what not.
    #[serde(default)]
    pub about: String,
    /// The licence of the weights.
    pub licence: String,
    /// Folder of the files, relative to the description's folder.
    #[serde(default = "crate::description::here")]
    pub files_root: PathBuf,
    /// The files and how to feed them.
    pub segment: SegmentDescription,
}

/// What a segmenter is made of.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum SegmentDescription {
    /// Segment Anything.
    Sam(SamFiles),
}

/// The files of SAM and how images are prepared for them.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamFiles {
    /// From an image to its embedding.
    pub image_encoder: FileRef,
    /// From points and the embedding to masks.
    pub mask_decoder: FileRef,
    /// Edge of the square that the encoder takes, pixels.
    #[serde(default = "sam_size_px")]
    pub size_px: u16,
    /// Subtracted from level / 255, per channel.
    #[serde(default = "imagenet_mean")]
    pub mean: [f64; 3],
    /// Divided by after that, per channel.
    #[serde(default = "imagenet_std")]
    pub std: [f64; 3],
}

fn sam_size_px() -> u16 {
    1024
}

fn imagenet_mean() -> [f64; 3] {
    [0.485, 0.456, 0.406]
}

fn imagenet_std() -> [f64; 3] {
    [0.229, 0.224, 0.225]
}

impl SamDescription {
    /// Reads and checks `path`.
    /// # Errors
    /// [`DescriptionError`] where it cannot be read or used.
    pub fn read(path: &Path) -> Result<Self, DescriptionError> {
        let description: Self = read_toml(path)?;
        check_common(path, &description.name, &description.files_root, &description.files())?;
        let SegmentDescription::Sam(sam) = &description.segment;
        let (size_px, expected) = (sam.size_px, "64 to 2048");
        require(path, (64..=2048).contains(&size_px), "segment.size_px", size_px.to_string(), expected)?;
        let finite = sam.mean.iter().all(|x| x.is_finite());
        require(path, finite, "segment.mean", format!("{:?}", sam.mean), "three finite numbers")?;
        let positive = sam.std.iter().all(|x| x.is_finite() && *x > 0.0);
        require(path, positive, "segment.std", format!("{:?}", sam.std), "three numbers above 0")?;
        Ok(description)
    }

    /// Returns the files with their roles.
    pub fn files(&self) -> Vec<(&'static str, &FileRef)> {
        let SegmentDescription::Sam(sam) = &self.segment;
        vec![("segment.image_encoder", &sam.image_encoder), ("segment.mask_decoder", &sam.mask_decoder)]
    }
}

/// An opened SAM; runs of one file follow one another, the two files run side by side.
#[derive(Debug)]
pub struct Sam {
    id: String,
    size_px: u32,
    /// Pixel value of each level, per channel.
    values: [[f32; 256]; 3],
    encoder: Mutex<Model>,
    decoder: Mutex<Model>,
    names: Names,
}

/// Discovered names.
#[derive(Debug)]
struct Names {
    pixels: String,
    /// What the encoder gives the decoder.
    embeddings: Vec<Handed>,
    points: String,
    labels: String,
    scores: String,
    masks: String,
}

/// A tensor that goes from the encoder to the decoder.
#[derive(Debug)]
struct Handed {
    output: String,
    /// Of the output as declared; -1 is any size.
    shape: Vec<i64>,
    input: String,
}

/// What the encoder makes of an image.
#[derive(Clone, Debug)]
pub struct Embedding {
    /// By name of the decoder's input.
    tensors: Vec<(String, Tensor)>,
    /// How the image lay in the model's frame.
    pub frame: Frame,
}

impl Embedding {
    /// Returns each tensor with its shape, by name of the decoder's input.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[i64], &[f32])> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), &tensor.shape[..], &tensor.values[..]))
    }
}

/// How an image lies in the square that the encoder takes: its longer edge fills it, the rest is padding at
/// the right or below.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Edge of the square, pixels.
    pub size_px: u32,
    /// Width and height of the image, pixels.
    pub image_px: [u32; 2],
    /// Width and height of the image within the square, pixels.
    pub resized_px: [u32; 2],
}

impl Frame {
    /// Returns how an image of `image_px` (width, height; neither 0) lies in a square of `size_px`.
    pub fn new(size_px: u32, image_px: [u32; 2]) -> Self {
        let scale = f64::from(size_px) / f64::from(image_px[0].max(image_px[1]));
        let resized_px = image_px.map(|edge| ((f64::from(edge) * scale + 0.5) as u32).max(1));
        Self { size_px, image_px, resized_px }
    }

    /// Returns where a point of the image, pixels, lies in the square.
    pub fn point(&self, point_px: [f64; 2]) -> [f32; 2] {
        std::array::from_fn(|axis| {
            (point_px[axis] * (f64::from(self.resized_px[axis]) / f64::from(self.image_px[axis]))) as f32
        })
    }
}

/// What the decoder proposes for prompts.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded {
    /// The model's own guess of each mask's IoU, `[prompts][MASKS_PER_PROMPT]`.
    pub predicted_ious: Vec<f32>,
    /// Logits, `[prompts][MASKS_PER_PROMPT][rows][columns]`, of the whole square, padding included.
    pub logits: Vec<f32>,
    /// Columns and rows of the logits.
    pub logits_px: [u32; 2],
}

impl Sam {
    /// Opens the directory `dir`, whose `model.toml` has `[segment]`.
    /// # Errors
    /// [`ModelError`] where a file is absent or not as described, or ONNX Runtime does not load.
    pub fn open(dir: &Path, options: &SessionOptions) -> Result<Self, ModelError> {
        let path = dir.join(FILE_NAME);
        let description = SamDescription::read(&path)?;
        let files_root = dir.join(&description.files_root);
        let mut id = description.name.clone();
        for (_, file) in description.files() {
            id = format!("{id} {}", hex::encode(sha256_of(&files_root, file)?));
        }
        let SegmentDescription::Sam(sam) = &description.segment;
        let encoder = Model::open(&checked(&files_root, &sam.image_encoder)?.into(), options)?;
        let decoder = Model::open(&checked(&files_root, &sam.mask_decoder)?.into(), options)?;
        let size_px = u32::from(sam.size_px);
        let names = Names::discover(&encoder, &decoder, i64::from(size_px))?;
        Ok(Self {
            id: format!("{id} {:?} {:?} {size_px} px", sam.mean, sam.std),
            size_px,
            values: values_of_levels(sam.mean, sam.std),
            encoder: Mutex::new(encoder),
            decoder: Mutex::new(decoder),
            names,
        })
    }

    /// Returns what identifies the model: its name, the hashes of its files, and how images are prepared.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns an image's pixel values, `[3][size_px][size_px]`: resized so that the longer edge fills the square
    /// (Pillow's bilinear), scaled, and padded with zeros. `image` must have pixels.
    pub fn pixel_values(&self, image: &RgbImage) -> Vec<f32> {
        let Frame { resized_px: [width_px, height_px], .. } = self.frame_of(image);
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

    fn frame_of(&self, image: &RgbImage) -> Frame {
        Frame::new(self.size_px, [image.width(), image.height()])
    }

    /// Computes an image's embedding; `image` must have pixels.
    /// # Errors
    /// [`SessionError`] where the model fails.
    pub fn embed(&self, image: &RgbImage) -> Result<Embedding, SessionError> {
        let (size, pixels) = (i64::from(self.size_px), self.pixel_values(image));
        let mut encoder = self.encoder.lock().unwrap_or_else(PoisonError::into_inner);
        let input = encoder.tensor(vec![1, 3, size, size], &pixels)?;
        let handed = &self.names.embeddings;
        let outputs: Vec<_> = handed.iter().map(|h| (h.output.as_str(), &h.shape[..])).collect();
        let found = encoder.run_all(vec![(self.names.pixels.as_str(), input)], &outputs)?;
        let inputs = handed.iter().map(|h| h.input.clone());
        Ok(Embedding { tensors: inputs.zip(found).collect(), frame: self.frame_of(image) })
    }

    /// Proposes masks for `n_prompts` prompts of as many points each.
    ///
    /// `points`: `[n_prompts][points]` in the square, as [`Frame::point`] gives them. `labels`: of each point, 1
    /// within the object, 0 outside, -1 no point.
    /// # Errors
    /// [`SessionError`] where the model fails or gives other shapes than SAM's.
    pub fn decode(
        &self,
        embedding: &Embedding,
        n_prompts: usize,
        points: &[[f32; 2]],
        labels: &[i64],
    ) -> Result<Decoded, SessionError> {
        let mut decoder = self.decoder.lock().unwrap_or_else(PoisonError::into_inner);
        let n = n_prompts as i64;
        let n_points = (points.len() / n_prompts.max(1)) as i64;
        let mut inputs = vec![
            (self.names.points.as_str(), decoder.tensor(vec![1, n, n_points, 2], points.as_flattened())?),
            (self.names.labels.as_str(), decoder.tensor(vec![1, n, n_points], labels)?),
        ];
        for (name, tensor) in &embedding.tensors {
            inputs.push((name.as_str(), decoder.tensor(tensor.shape.clone(), &tensor.values)?));
        }
        let n_masks = MASKS_PER_PROMPT as i64;
        let outputs = [
            (self.names.scores.as_str(), &[1, n, n_masks][..]),
            (self.names.masks.as_str(), &[1, n, n_masks, -1, -1][..]),
        ];
        let mut found = decoder.run_all(inputs, &outputs)?;
        let (masks, scores) = (found.swap_remove(1), found.swap_remove(0));
        let logits_px = [masks.shape[4] as u32, masks.shape[3] as u32];
        // Fewer have no three taps; more than the square has pixels is no SAM's.
        if logits_px.iter().any(|edge| !(3..=self.size_px).contains(edge)) {
            let expected = format!("masks of 3 to {} px a side", self.size_px);
            return Err(
                decoder.layout_error(format!("masks are {} x {} px", logits_px[0], logits_px[1]), expected)
            );
        }
        Ok(Decoded { predicted_ious: scores.values, logits: masks.values, logits_px })
    }
}

impl Names {
    /// Finds out how the two files fit together.
    fn discover(encoder: &Model, decoder: &Model, size_px: i64) -> Result<Self, SessionError> {
        use TensorElementType::{Float32, Int64};
        let pixels = match &encoder.inputs()[..] {
            [(name, Some((Float32, shape)))] if matches!(shape[..], [_, 3 | -1, _, _]) => name.clone(),
            _ => {
                let expected = format!("an image encoder's only one, f32 [-1, 3, {size_px}, {size_px}]");
                return Err(
                    encoder.layout_error(format!("its inputs are {}", encoder.listed_inputs()), expected)
                );
            }
        };
        encoder.expect_input(pixels.as_str(), Float32, &[-1, 3, size_px, size_px])?;

        let offered = encoder.outputs();
        let (mut points, mut labels) = (Vec::new(), Vec::new());
        let (mut embeddings, mut others) = (Vec::new(), Vec::new());
        for (name, tensor) in decoder.inputs() {
            let given = offered.iter().find(|(output, _)| *output == name);
            match (given, tensor) {
                (Some((output, Some((Float32, shape)))), Some((Float32, _))) => {
                    embeddings.push(Handed { output: output.clone(), shape: shape.clone(), input: name });
                }
                (_, Some((Float32, shape))) if matches!(shape[..], [_, _, _, 2]) => points.push(name),
                (_, Some((Int64, shape))) if shape.len() == 3 => labels.push(name),
                _ => others.push(name),
            }
        }
        // Exports that give a single embedding do not always call it the same on both sides.
        if let ([_], [(output, Some((Float32, shape)))], true) =
            (&others[..], &offered[..], embeddings.is_empty())
        {
            let input = others.swap_remove(0);
            embeddings.push(Handed { output: output.clone(), shape: shape.clone(), input });
        }
        let listed = || format!("its inputs are {}", decoder.listed_inputs());
        let ([points], [labels], [_, ..], []) = (&points[..], &labels[..], &embeddings[..], &others[..])
        else {
            let names: Vec<&str> = offered.iter().map(|(name, _)| name.as_str()).collect();
            let expected = format!(
                "points f32 [-1, -1, -1, 2], their labels i64 [-1, -1, -1], the image encoder's {}, and no more \
                 (no boxes, no earlier masks)",
                names.join(", ")
            );
            return Err(decoder.layout_error(listed(), expected));
        };
        let output = |expected: &[i64]| {
            let mut fitting = decoder.outputs().into_iter().filter(|(_, tensor)| {
                matches!(tensor, Some((Float32, shape)) if crate::session::shapes_fit(shape, expected))
            });
            fitting.next().map(|(name, _)| name).ok_or_else(|| {
                let found = format!("its outputs are {}", decoder.listed_outputs());
                decoder.layout_error(found, format!("one of them f32 {expected:?}"))
            })
        };
        let n_masks = MASKS_PER_PROMPT as i64;
        Ok(Self {
            pixels,
            embeddings,
            points: points.clone(),
            labels: labels.clone(),
            scores: output(&[-1, -1, n_masks])?,
            masks: output(&[-1, -1, n_masks, -1, -1])?,
        })
    }
}
