//! Model directories: image and text encoders that share one embedding space.
//!
//! A [`ModelDir`] is described by one TOML file ([`description`]). Its image side turns crops into
//! vectors ([`ImageEncoder`]), its text side turns queries into vectors of the same space
//! ([`TextEncoder`]): through ONNX Runtime ([`session`]), from a list of phrases ([`phrases`]), or
//! without a model at all ([`colours`]). [`boundaries`] finds where things end. Encoders of our own are part of the program ([`ModelDir::embedded`]). [`sam`] finds masks. [`EncoderId`] names the space, so that a robot can refuse
//! to compare vectors of two spaces.
//!
//! [`hub`] brings public models here, and [`commands`] is the face that both programs give it.
//!
//! Nothing here prints, reads the environment or starts threads of its own, save the question of [`commands::ask`].

pub mod boundaries;
pub mod clean;
pub mod colours;
pub mod commands;
mod crop;
pub mod description;
pub mod encoder_id;
mod error;
pub mod hub;
pub mod image;
mod model_dir;
mod model_file;
pub mod phrases;
pub mod preprocess;
mod provider;
pub mod sam;
pub mod session;
pub mod tensors;
pub mod text;

pub use crop::Crop;
pub use encoder_id::EncoderId;
pub use error::{EncodeError, ModelError};
pub use model_dir::ModelDir;
pub use model_file::ModelFile;
pub use provider::{NoProvider, Placement, Provider};
pub use session::{SessionOptions, find_runtime};

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
