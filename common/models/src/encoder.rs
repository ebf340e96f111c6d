//! What image and text encoders have in common.

use crate::crop::Crop;
use crate::error::EncodeError;
use crate::placement::Placement;

/// Turns crops of photographs into unit vectors.
pub trait ImageEncoder: Send {
    /// Returns the number of components of a vector.
    fn dim(&self) -> usize;

    /// Returns how many crops are best encoded together.
    fn preferred_batch(&self) -> usize;

    /// Encodes `crops`: `[n]` in, `[n][dim]` out, unit vectors, row-major.
    ///
    /// Memory is bounded by the preferred batch, however many crops are given.
    /// # Errors
    /// [`EncodeError`] where a crop is empty or the model fails.
    fn encode(&mut self, crops: &[Crop]) -> Result<Vec<f32>, EncodeError>;

    /// Returns what ONNX Runtime really runs it on; `None` where it does without.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Turns words into unit vectors of the image encoder's space.
pub trait TextEncoder: Send {
    /// Returns the name of the model.
    fn name(&self) -> &str;

    /// Returns the number of components of a vector.
    fn dim(&self) -> usize;

    /// Encodes `text`: `[dim]`, a unit vector, centred as the description says.
    /// # Errors
    /// [`EncodeError`] where the text is empty or unknown, or the model fails.
    fn encode(&mut self, text: &str) -> Result<Vec<f32>, EncodeError>;

    /// Returns all that it knows, where that is a list; `None` where it takes any text.
    fn vocabulary(&self) -> Option<&[String]> {
        None
    }

    /// Returns what ONNX Runtime really runs it on; `None` where it does without.
    fn placement(&self) -> Option<&Placement> {
        None
    }
}

/// Scales `vector` to unit length, computed in f64; returns false, leaving it, where it is zero or not finite.
pub(crate) fn normalise(vector: &mut [f32]) -> bool {
    let norm = vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
    let usable = norm.is_finite() && norm > 0.0;
    if usable {
        vector.iter_mut().for_each(|x| *x = (f64::from(*x) / norm) as f32);
    }
    usable
}
