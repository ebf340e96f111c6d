//! Image encoders in ONNX.

use ort::value::TensorElementType;

use crate::{
    Crop, EncodeError, ImageEncoder, ModelError,
    description::ImageDescription,
    normalise,
    preprocess::Preprocess,
    session::{Model, Provider, SessionOptions},
};

/// Where a unit vector of f32 may end up after a model's own scaling.
const UNIT_TOLERANCE: f64 = 1e-3;

/// An image encoder that runs an ONNX file.
#[derive(Debug)]
pub struct OnnxImageEncoder {
    name: String,
    dim: usize,
    model: Model,
    preprocess: Preprocess,
    input: String,
    output: String,
    normalise: bool,
    batch: usize,
}

impl OnnxImageEncoder {
    /// Opens `path` as `description` says; `dim`: components of a vector.
    /// # Errors
    /// [`ModelError::Session`] where the runtime or the file is not as described.
    pub fn open(
        name: &str,
        dim: usize,
        path: &std::path::Path,
        description: &ImageDescription,
        options: &SessionOptions,
    ) -> Result<Self, ModelError> {
        let model = Model::open(path, options)?;
        let preprocess = description.preprocess();
        let size = i64::from(preprocess.size_px());
        model.expect_input(&description.input, TensorElementType::Float32, &[-1, 3, size, size])?;
        model.expect_no_input_but(&[&description.input])?;
        model.expect_output(&description.output, TensorElementType::Float32, &[-1, dim as i64])?;
        Ok(Self {
            name: name.to_owned(),
            dim,
            model,
            preprocess,
            input: description.input.clone(),
            output: description.output.clone(),
            normalise: description.normalise,
            batch: usize::from(description.batch),
        })
    }

    /// Returns what it runs on.
    pub fn provider(&self) -> Provider {
        self.model.provider()
    }

    /// Scales or checks vector `index` of the call.
    fn finish(&self, vector: &mut [f32], index: usize) -> Result<(), EncodeError> {
        let norm = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
        if !norm.is_finite() || (self.normalise && !normalise(vector)) {
            return Err(EncodeError::NoDirection { model: self.name.clone(), index });
        }
        if !self.normalise && (norm - 1.0).abs() > UNIT_TOLERANCE {
            return Err(EncodeError::NotUnit { model: self.name.clone(), index, norm });
        }
        Ok(())
    }
}

impl ImageEncoder for OnnxImageEncoder {
    fn dim(&self) -> usize {
        self.dim
    }

    fn preferred_batch(&self) -> usize {
        self.batch
    }

    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, EncodeError> {
        if let Some(index) = crops.iter().position(|crop| crop.inside().is_empty()) {
            return Err(EncodeError::EmptyCrop { index });
        }
        let mut vectors = Vec::with_capacity(crops.len() * self.dim);
        let size = i64::from(self.preprocess.size_px());
        for crops in crops.chunks(self.batch) {
            let mut pixels = Vec::with_capacity(crops.len() * 3 * (size * size) as usize);
            for crop in crops {
                self.preprocess.append_pixel_values(crop.image(), &mut pixels);
            }
            let n = crops.len() as i64;
            let input = self.model.tensor(vec![n, 3, size, size], &pixels)?;
            let inputs = vec![(self.input.as_str(), input)];
            let mut batch = self.model.run(inputs, &self.output, &[n, self.dim as i64])?;
            for (i, vector) in batch.chunks_exact_mut(self.dim).enumerate() {
                self.finish(vector, vectors.len() / self.dim + i)?;
            }
            vectors.append(&mut batch);
        }
        Ok(vectors)
    }
}
