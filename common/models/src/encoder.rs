//! The traits of image and text encoders.

use std::sync::Arc;

use image::RgbImage;

use crate::error::InferenceError;
use crate::placement::Placement;
use crate::synonyms::KnownPhrases;

pub trait ImageEncoder: Send {
    fn dim(&self) -> usize;

    /// Returns the number of crops to encode together for the best throughput.
    fn preferred_batch(&self) -> usize;

    /// Encodes `crops`: `[n]` in, `[n][dim]` out, unit vectors, row-major.
    ///
    /// Memory is bounded by the preferred batch, however many crops are given.
    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, InferenceError>;

    /// Returns the patches along each side of the square over which photos are stretched for
    /// [`Self::encode_patches`]; `None` if the encoder has no vectors of patches.
    fn patches_per_side(&self) -> Option<u32> {
        None
    }

    /// Encodes the patches of a whole photo: `[patches_per_side^2][dim]`, unit vectors, row by row; `None` if the
    /// encoder has no vectors of patches.
    fn encode_patches(&mut self, _photo: &RgbImage) -> Result<Option<Vec<f32>>, InferenceError> {
        Ok(None)
    }

    /// Returns the device that ONNX Runtime runs the model on; `None` without ONNX Runtime.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Turns words into unit vectors of the image encoder's space.
pub trait TextEncoder: Send {
    fn dim(&self) -> usize;

    /// Encodes `text`: `[dim]`, a unit vector, centred if the description asks for it.
    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError>;

    /// Returns the phrases that it knows, if it knows some and not others.
    fn known_phrases(&self) -> Option<&Arc<KnownPhrases>> {
        None
    }

    /// Returns the phrases or words that it accepts; `None` if it accepts any text.
    fn vocabulary(&self) -> Option<&[String]> {
        None
    }

    /// Returns the words that things can be called by, if it knows some and not others; `None` if everyday nouns do.
    fn nouns(&self) -> Option<&[String]> {
        self.vocabulary()
    }

    /// Returns the device that ONNX Runtime runs the model on; `None` without ONNX Runtime.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Scales `vector` to unit length, computing in f64. Returns false and leaves it unchanged if it is zero or not
/// finite.
pub(crate) fn normalise(vector: &mut [f32]) -> bool {
    let norm = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
    let usable = norm.is_finite() && norm > 0.0;
    if usable {
        vector.iter_mut().for_each(|x| *x = (f64::from(*x) / norm) as f32);
    }
    usable
}

/// A piece of a photograph and the mask of the object that it shows; clones share the pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Crop {
    image: Arc<RgbImage>,
    inside: Arc<[bool]>,
}

impl Crop {
    /// Returns a crop; `inside`: `[height][width]`, row-major. `None` if the sizes differ.
    pub fn new(image: RgbImage, inside: Vec<bool>) -> Option<Self> {
        let (width_px, height_px) = image.dimensions();
        (u64::from(width_px) * u64::from(height_px) == inside.len() as u64)
            .then(|| Self { image: image.into(), inside: inside.into() })
    }

    /// Returns a crop whose mask covers every pixel.
    pub fn whole(image: RgbImage) -> Self {
        let inside = vec![true; image.as_raw().len() / 3];
        Self { image: image.into(), inside: inside.into() }
    }

    /// Returns the pixels; the background may be filled.
    pub fn image(&self) -> &RgbImage {
        &self.image
    }

    /// Returns the mask, `[height][width]`, row-major.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
}
