//! The traits of image and text encoders.

use std::sync::Arc;

use image::RgbImage;

use crate::error::InferenceError;
use crate::placement::Placement;
use crate::synonyms::KnownPhrases;

pub trait ImageEncoder: Send {
    fn dim(&self) -> usize;

    /// Crops to encode together for the best throughput.
    fn preferred_batch(&self) -> usize;

    /// Encodes `[n]` crops to `[n][dim]`, unit vectors, row-major. Memory is bounded by the preferred batch.
    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, InferenceError>;

    /// Patches along each side of the square of [`Self::encode_patches`]; `None` without vectors of patches.
    fn patches_per_side(&self) -> Option<u32> {
        None
    }

    /// Encodes the patches of a photo: `[patches_per_side^2][dim]`, unit vectors, row by row; `None` without
    /// vectors of patches.
    fn encode_patches(&mut self, _photo: &RgbImage) -> Result<Option<Vec<f32>>, InferenceError> {
        Ok(None)
    }

    /// The device on which ONNX Runtime runs the model; `None` without ONNX Runtime.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Turns words into unit vectors of the image encoder's space.
pub trait TextEncoder: Send {
    fn dim(&self) -> usize;

    /// Encodes `text`: `[dim]`, a unit vector, centred if the description asks for it.
    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError>;

    /// The known phrases of an encoder that does not know all.
    fn known_phrases(&self) -> Option<&Arc<KnownPhrases>> {
        None
    }

    /// The accepted phrases or words; `None` if any text is accepted.
    fn vocabulary(&self) -> Option<&[String]> {
        None
    }

    /// Words that can name objects, if they are limited; `None` stands for everyday nouns.
    fn nouns(&self) -> Option<&[String]> {
        self.vocabulary()
    }

    /// The device on which ONNX Runtime runs the model; `None` without ONNX Runtime.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Scales to unit length in f64; returns false and changes nothing if the vector is zero or not finite.
pub(crate) fn normalise(vector: &mut [f32]) -> bool {
    let norm = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
    let usable = norm.is_finite() && norm > 0.0;
    if usable {
        vector.iter_mut().for_each(|x| *x = (f64::from(*x) / norm) as f32);
    }
    usable
}

/// A part of a photo and the mask of its object; clones share the pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Crop {
    image: Arc<RgbImage>,
    inside: Arc<[bool]>,
}

impl Crop {
    /// `inside`: `[height][width]`, row-major; `None` if the sizes differ.
    pub fn new(image: RgbImage, inside: Vec<bool>) -> Option<Self> {
        let (width_px, height_px) = image.dimensions();
        (u64::from(width_px) * u64::from(height_px) == inside.len() as u64)
            .then(|| Self { image: image.into(), inside: inside.into() })
    }

    pub fn whole(image: RgbImage) -> Self {
        let inside = vec![true; image.as_raw().len() / 3];
        Self { image: image.into(), inside: inside.into() }
    }

    /// The background may be filled.
    pub fn image(&self) -> &RgbImage {
        &self.image
    }

    /// The mask, `[height][width]`, row-major.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
}
