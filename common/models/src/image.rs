//! Image encoders in ONNX.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant};

use half::f16;
use image::RgbImage;
use ort::value::TensorElementType;

use crate::{
    Crop, ImageEncoder, InferenceError, ModelError, ModelFile,
    bound::{Place, Turns},
    description::ImageDescription,
    encoder::normalise,
    levels::Levels,
    placement::DeviceMemory,
    placement::Placement,
    preprocess::Preprocess,
    session::{Model, SessionOptions},
};

/// Largest deviation from length 1 of vectors that the model normalises itself.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Batch size of models whose vectors depend on it; constant, so that vectors are the same on every machine.
const FIXED_BATCH: usize = 16;

/// Default batch size on a GPU: CLIP ViT-B/32 gains nothing from larger ones on an H100.
const GPU_BATCH: usize = 256;

/// Least saving of time per crop for which doubling the batch is worth its memory.
const WORTHWHILE: f64 = 0.05;

/// An image encoder that runs an ONNX file.
///
/// On an NVIDIA GPU, squares go to the GPU as bytes and batches have one shape: unused places of a batch are computed
/// too, so that a crop's vector does not depend on the number of others.
///
/// On other devices, if the description states no batch size, the fastest of 1, 2, 4, 8, 16 and 32 is measured
/// once a process, among those that leave a crop's vector bit for bit the same. Models whose vectors depend on the
/// rest of the batch (8-bit ones with scales computed at run time) always get 16.
#[derive(Debug)]
pub struct OnnxImageEncoder {
    name: String,
    dim: usize,
    model: Model,
    preprocess: Preprocess,
    input: String,
    is_f16: bool,
    output: String,
    normalise: bool,
    batch: Option<usize>,
    /// Output of patch vectors; patches along a side.
    patches: Option<(String, u32)>,
    /// GPU memory and conversion, if the model runs on a GPU that allows it.
    on_gpu: Option<OnGpu>,
}

#[derive(Debug)]
struct OnGpu {
    memory: DeviceMemory,
    levels: Levels,
    turns: Arc<Turns>,
}

impl OnnxImageEncoder {
    /// `dim`: components of a vector.
    pub fn open(
        name: &str,
        dim: usize,
        file: &ModelFile,
        description: &ImageDescription,
        options: &SessionOptions,
    ) -> Result<Self, ModelError> {
        let mut model = Model::open(file, options)?;
        let memory = model.memory.take();
        let preprocess = description.preprocess();
        let size = i64::from(preprocess.size_px());
        let (f32, input) = (TensorElementType::Float32, description.input.as_str());
        let slot = model.expect_input(input, f32, &[-1, 3, size, size])?;
        let takes_one = slot.shape[0] != -1;
        if takes_one {
            model.expect_input(input, f32, &[1, 3, size, size])?;
        }
        model.expect_no_input_but(&[input])?;
        let output = model.expect_output(description.output.as_deref(), f32, &[-1, dim as i64])?.name;
        let mut patches = None;
        if let (Some(of), Some(per_side)) = (&description.patches, description.patches_per_side()) {
            let n = i64::from(per_side).pow(2);
            let slot = model.expect_output(of.output.as_str(), f32, &[-1, n, dim as i64])?;
            patches = Some((slot.name, per_side));
        }
        let mut encoder = Self {
            name: name.to_owned(),
            dim,
            model,
            preprocess,
            input: input.to_owned(),
            is_f16: slot.element == TensorElementType::Float16,
            output,
            normalise: description.normalise,
            patches,
            batch: if takes_one { Some(1) } else { description.batch.map(usize::from) },
            on_gpu: None,
        };
        if let Some(memory) = memory {
            encoder.bind(memory, options)?;
        }
        Ok(encoder)
    }

    /// Runs batches through this memory from now on.
    fn bind(&mut self, memory: DeviceMemory, options: &SessionOptions) -> Result<(), ModelError> {
        let batch = *self.batch.get_or_insert(GPU_BATCH);
        let levels = Levels::open(batch, &self.preprocess, self.is_f16, &memory, options)?;
        self.on_gpu = Some(OnGpu { memory, levels, turns: Turns::of(options.gpu) });
        Ok(())
    }

    /// Sets a batch size that the description leaves open to `measured`, which is measured if absent.
    pub(crate) fn settle_batch(&mut self, measured: &mut Option<usize>) -> Result<(), ModelError> {
        if self.batch.is_none() {
            self.batch = Some(match *measured {
                Some(batch) => batch,
                None => *measured.insert(self.measure_batch()?),
            });
        }
        Ok(())
    }

    fn measure_batch(&mut self) -> Result<usize, ModelError> {
        let n_values = 3 * (self.preprocess.size_px() as usize).pow(2);
        // Noise of two strengths, between which scales computed at run time differ.
        let mut state = 1u32;
        let mut noise = |strength: f32| -> Vec<f32> {
            let mut next = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                ((state >> 8) as f32 / (1 << 23) as f32 - 1.0) * strength
            };
            (0..n_values).map(|_| next()).collect()
        };
        let (weak, strong) = (noise(0.5), noise(2.0));
        let alone = self.run(&weak, 1)?;
        let dim = self.dim;
        let mut timed = |batch: usize| -> Result<(Duration, bool), ModelError> {
            let crop = |i: usize| if i == 0 || i + 1 == batch { &weak } else { &strong };
            let pixels: Vec<f32> = (0..batch).flat_map(crop).copied().collect();
            let start = Instant::now();
            let vectors = self.run(&pixels, batch)?;
            let took = start.elapsed() / batch as u32;
            Ok((took, vectors[..dim] == alone && vectors[(batch - 1) * dim..] == alone))
        };
        let (_, is_invariant) = timed(4)?;
        if !is_invariant {
            tracing::debug!("{}: vectors depend on the batch, so its size is {FIXED_BATCH}", self.name);
            return Ok(FIXED_BATCH);
        }
        let (mut best, mut best_time) = (1, timed(1)?.0);
        for batch in [2, 4, 8, 16, 32] {
            let (time, is_invariant) = timed(batch)?;
            if !is_invariant || time > best_time.mul_f64(1.0 - WORTHWHILE) {
                break;
            }
            (best, best_time) = (batch, time);
        }
        tracing::debug!("{}: {best_time:?} a crop in batches of {best}", self.name);
        Ok(best)
    }

    /// Vectors of at most a batch of crops, `[n][dim]`.
    fn vectors(&mut self, crops: &[Crop]) -> Result<Vec<f32>, ModelError> {
        let Some(OnGpu { memory, levels, turns }) = &mut self.on_gpu else {
            let mut pixels = Vec::new();
            for crop in crops {
                self.preprocess.append_pixel_values(crop.image(), &mut pixels);
            }
            return self.run(&pixels, crops.len());
        };
        let size = self.preprocess.size_px();
        let squares = crops.iter().map(|crop| match crop.image().dimensions() == (size, size) {
            true => Cow::Borrowed(crop.image()),
            false => Cow::Owned(self.preprocess.square(crop.image())),
        });
        let pixels = levels.values(memory, squares)?;
        let inputs = [(self.input.as_str(), &pixels)];
        let turn = turns.take();
        let mut found = self.model.run_bound(memory, &inputs, &[(&self.output, Place::Host)])?;
        drop(turn);
        let vectors = self.model.floats(found.pop(), &self.output, &[-1, self.dim as i64])?.values;
        Ok(vectors[..crops.len() * self.dim].to_vec())
    }

    /// Runs the model on `[n][3][size_px][size_px]`; returns its vectors, `[n][dim]`.
    fn run(&mut self, pixels: &[f32], n: usize) -> Result<Vec<f32>, ModelError> {
        let (output, dim) = (self.output.clone(), self.dim as i64);
        self.run_for(pixels, n, &output, &[n as i64, dim])
    }

    /// Runs the model on `[n][3][size_px][size_px]`; returns `output`, which has `shape`.
    fn run_for(
        &mut self,
        pixels: &[f32],
        n: usize,
        output: &str,
        shape: &[i64],
    ) -> Result<Vec<f32>, ModelError> {
        let size = i64::from(self.preprocess.size_px());
        let input_shape = vec![n as i64, 3, size, size];
        let halves: Vec<f16>;
        let input = match self.is_f16 {
            true => {
                halves = pixels.iter().map(|&x| f16::from_f32(x)).collect();
                self.model.tensor(input_shape, &halves)?
            }
            false => self.model.tensor(input_shape, pixels)?,
        };
        self.model.run(vec![(self.input.as_str(), input)], output, shape)
    }

    /// Normalises vector `index` of the call, or checks its length.
    fn finish(&self, vector: &mut [f32], index: usize) -> Result<(), InferenceError> {
        let norm = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
        if !norm.is_finite() || (self.normalise && !normalise(vector)) {
            return Err(InferenceError::NoDirection { model: self.name.clone(), index });
        }
        if !self.normalise && (norm - 1.0).abs() > UNIT_TOLERANCE {
            return Err(InferenceError::NotUnit { model: self.name.clone(), index, norm });
        }
        Ok(())
    }
}

impl ImageEncoder for OnnxImageEncoder {
    fn dim(&self) -> usize {
        self.dim
    }

    fn preferred_batch(&self) -> usize {
        self.batch.unwrap_or(FIXED_BATCH)
    }

    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, InferenceError> {
        if let Some(index) = crops.iter().position(|crop| crop.inside().is_empty()) {
            return Err(InferenceError::EmptyCrop { index });
        }
        let mut vectors = Vec::with_capacity(crops.len() * self.dim);
        for crops in crops.chunks(self.preferred_batch()) {
            let mut batch = self.vectors(crops)?;
            for (i, vector) in batch.chunks_exact_mut(self.dim).enumerate() {
                self.finish(vector, vectors.len() / self.dim + i)?;
            }
            vectors.append(&mut batch);
        }
        Ok(vectors)
    }

    fn patches_per_side(&self) -> Option<u32> {
        self.patches.as_ref().map(|(_, per_side)| *per_side)
    }

    fn encode_patches(&mut self, photo: &RgbImage) -> Result<Option<Vec<f32>>, InferenceError> {
        let Some((output, per_side)) = self.patches.clone() else { return Ok(None) };
        if photo.width() == 0 || photo.height() == 0 {
            return Err(InferenceError::EmptyCrop { index: 0 });
        }
        let mut pixels = Vec::new();
        self.preprocess.stretched().append_pixel_values(photo, &mut pixels);
        let shape = [1, i64::from(per_side).pow(2), self.dim as i64];
        let mut vectors = self.run_for(&pixels, 1, &output, &shape)?;
        for (index, vector) in vectors.chunks_exact_mut(self.dim).enumerate() {
            self.finish(vector, index)?;
        }
        Ok(Some(vectors))
    }

    fn placement(&self) -> Option<&Placement> {
        Some(&self.model.placement)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::description::Description;

    /// Bound memory gives the same vectors as the plain way, for any batch, full or not.
    #[test]
    fn bound_batches_give_the_same_vectors() {
        let folder = slag_test_support::workspace_root().join("common/models/embedded");
        let text = fs_err::read_to_string(folder.join("model.toml")).expect("the description");
        let description = Description::parse(Path::new("model.toml"), &text).expect("valid");
        let options = SessionOptions::new(slag_test_support::onnx_runtime());
        let file = ModelFile::from(folder.join("image.onnx"));
        let dim = description.dim as usize;
        let open = || OnnxImageEncoder::open("embedded", dim, &file, &description.image, &options);
        let crops: Vec<Crop> = (0..7u32)
            .map(|k| {
                // Squares of the model's size, and other shapes.
                let (width, height) = if k % 2 == 0 { (64, 64) } else { (20 + 9 * k, 31) };
                let level = |x: u32, y: u32, c: u32| (x * (3 + k) + y * (7 - k) + 83 * c) as u8;
                Crop::whole(RgbImage::from_fn(width, height, |x, y| {
                    ::image::Rgb([0, 1, 2].map(|channel| level(x, y, channel)))
                }))
            })
            .collect();
        let mut plain = open().expect("opens");
        plain.batch = Some(1);
        let expected = plain.encode(&crops).expect("runs");
        let mut first: Option<Vec<f32>> = None;
        for batch in [1, 3, 16] {
            let mut bound = open().expect("opens");
            bound.batch = Some(batch);
            bound.bind(DeviceMemory::of_processor(), &options).expect("binds");
            let found = bound.encode(&crops).expect("runs");
            for (a, b) in found.chunks_exact(dim).zip(expected.chunks_exact(dim)) {
                let cosine: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                // Pixel values by product and sum differ from the table's in the last bit.
                assert!(cosine > 1.0 - 1e-5, "batch {batch}: {cosine}");
            }
            assert!(first.get_or_insert(found.clone()) == &found, "batch {batch}");
        }
    }
}
