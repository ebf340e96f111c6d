//! Segment Anything (Kirillov et al. 2023) in two ONNX files: an image encoder, and a prompt encoder with the
//! mask decoder. SAM, MobileSAM, EdgeSAM and SAM-HQ have this layout.
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
//! size_px = 1024                   # this and the next two: SAM's values if left out
//! mean = [0.485, 0.456, 0.406]     # pixel value = (level / 255 - mean) / std
//! std = [0.229, 0.224, 0.225]
//! ```
//!
//! Inputs and outputs are not named in the description: the decoder's inputs are matched with the encoder's outputs
//! by name, points and labels by type and shape.

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

/// Masks that SAM proposes for a prompt: subpart, part and whole, in that order.
pub const MASKS_PER_PROMPT: usize = 3;

/// The description of a segmenter's directory.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamDescription {
    /// The model's name.
    pub name: String,
    /// Its strengths and limits, for people.
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

/// The kinds of segmenters.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum SegmentDescription {
    /// Segment Anything.
    Sam(SamFiles),
}

/// The files of SAM and its image preprocessing.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamFiles {
    /// The model from an image to its embedding.
    pub image_encoder: FileRef,
    /// The model from points and the embedding to masks.
    pub mask_decoder: FileRef,
    /// Edge length of the encoder's input square, in pixels.
    #[serde(default = "sam_size_px")]
    pub size_px: u16,
    /// Subtracted from level / 255, per channel.
    #[serde(default = "imagenet_mean")]
    pub mean: [f64; 3],
    /// Divisor after the subtraction, per channel.
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
    /// [`DescriptionError`] if it cannot be read or is invalid.
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

/// An opened SAM. Each file runs one call at a time; the two files can run in parallel.
#[derive(Debug)]
pub struct Sam {
    id: String,
    size_px: u32,
    /// Pixel value for each level, per channel.
    values: [[f32; 256]; 3],
    encoder: Mutex<Model>,
    decoder: Mutex<Model>,
    names: Names,
}

/// The names of inputs and outputs.
#[derive(Debug)]
struct Names {
    pixels: String,
    /// Tensors that the decoder takes from the encoder.
    embeddings: Vec<Link>,
    points: String,
    labels: String,
    scores: String,
    masks: String,
}

/// An output of the encoder and the input of the decoder that takes it.
#[derive(Debug)]
struct Link {
    output: String,
    /// Declared shape of the output; -1 is any size.
    shape: Vec<i64>,
    input: String,
}

/// The encoder's output for an image.
#[derive(Clone, Debug)]
pub struct Embedding {
    /// Tensors by the name of the decoder's input.
    tensors: Vec<(String, Tensor)>,
    /// Placement of the image in the encoder's square.
    pub letterbox: Letterbox,
}

impl Embedding {
    /// Returns the tensors: name of the decoder's input, shape, values.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[i64], &[f32])> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), &tensor.shape[..], &tensor.values[..]))
    }
}

/// Placement of an image in the encoder's square: the longer edge fills it, the rest is padding at the right or
/// the bottom.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Letterbox {
    /// Edge length of the square, in pixels.
    pub size_px: u32,
    /// Width and height of the image, in pixels.
    pub image_px: [u32; 2],
    /// Width and height of the resized image, in pixels.
    pub resized_px: [u32; 2],
}

impl Letterbox {
    /// Returns the placement of an image of `image_px` (width, height; neither 0) in a square of `size_px`.
    pub fn new(size_px: u32, image_px: [u32; 2]) -> Self {
        let scale = f64::from(size_px) / f64::from(image_px[0].max(image_px[1]));
        let resized_px = image_px.map(|edge| ((f64::from(edge) * scale + 0.5) as u32).max(1));
        Self { size_px, image_px, resized_px }
    }

    /// Converts a point from pixels of the image to pixels of the square.
    pub fn point(&self, point_px: [f64; 2]) -> [f32; 2] {
        std::array::from_fn(|axis| {
            (point_px[axis] * (f64::from(self.resized_px[axis]) / f64::from(self.image_px[axis]))) as f32
        })
    }
}

/// The decoder's output for prompts.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded {
    /// The model's estimate of each mask's IoU, `[prompts][MASKS_PER_PROMPT]`.
    pub predicted_ious: Vec<f32>,
    /// Logits of the whole square, padding included: `[prompts][MASKS_PER_PROMPT][rows][columns]`.
    pub logits: Vec<f32>,
    /// Columns and rows of the logits.
    pub logits_px: [u32; 2],
}

impl Sam {
    /// Opens the directory `dir`; its `model.toml` must have `[segment]`.
    /// # Errors
    /// [`ModelError`] if a file is absent or not as described, or ONNX Runtime does not load.
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

    /// Returns the model's identity: its name, the hashes of its files, and its preprocessing.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns an image's pixel values, `[3][size_px][size_px]`: resized to fill the square with the longer edge
    /// (Pillow's bilinear), normalised, and padded with zeros. `image` must have pixels.
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
        Letterbox::new(self.size_px, [image.width(), image.height()])
    }

    /// Computes an image's embedding; `image` must have pixels.
    /// # Errors
    /// [`SessionError`] if the model fails.
    pub fn embed(&self, image: &RgbImage) -> Result<Embedding, SessionError> {
        let (size, pixels) = (i64::from(self.size_px), self.pixel_values(image));
        let mut encoder = self.encoder.lock().unwrap_or_else(PoisonError::into_inner);
        let input = encoder.tensor(vec![1, 3, size, size], &pixels)?;
        let links = &self.names.embeddings;
        let outputs: Vec<_> = links.iter().map(|link| (link.output.as_str(), &link.shape[..])).collect();
        let found = encoder.run_all(vec![(self.names.pixels.as_str(), input)], &outputs)?;
        let inputs = links.iter().map(|link| link.input.clone());
        Ok(Embedding { tensors: inputs.zip(found).collect(), letterbox: self.letterbox_of(image) })
    }

    /// Proposes masks for `n_prompts` prompts with the same number of points each.
    ///
    /// `points`: `[n_prompts][points]` in pixels of the square, see [`Letterbox::point`]. `labels`: for each point, 1
    /// inside the object, 0 outside, -1 no point.
    /// # Errors
    /// [`SessionError`] if the model fails or its output is not of SAM's shapes.
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
        // The upsampling needs 3; SAM's logits are never larger than the square.
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
    /// Matches the inputs and outputs of the two files.
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
                    embeddings.push(Link { output: output.clone(), shape: shape.clone(), input: name });
                }
                (_, Some((Float32, shape))) if matches!(shape[..], [_, _, _, 2]) => points.push(name),
                (_, Some((Int64, shape))) if shape.len() == 3 => labels.push(name),
                _ => others.push(name),
            }
        }
        // Some exports name a single embedding differently on both sides.
        if let ([_], [(output, Some((Float32, shape)))], true) =
            (&others[..], &offered[..], embeddings.is_empty())
        {
            let input = others.swap_remove(0);
            embeddings.push(Link { output: output.clone(), shape: shape.clone(), input });
        }
        let listed = || format!("its inputs are {}", decoder.listed_inputs());
        let ([points], [labels], [_, ..], []) = (&points[..], &labels[..], &embeddings[..], &others[..])
        else {
            let names: Vec<&str> = offered.iter().map(|(name, _)| name.as_str()).collect();
            let expected = format!(
                "points f32 [-1, -1, -1, 2], their labels i64 [-1, -1, -1], the image encoder's {}, and no others \
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
