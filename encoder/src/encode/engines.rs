//! What does the work of an encode: models, the rasteriser and, in experiments, something that disturbs masks.

use slag_models::{ModelDir, SessionOptions};

use crate::masks::Mask;
use crate::raster::Rasterizer;

/// What does the work of an encode.
#[derive(Clone, Copy)]
pub struct Engines<'a> {
    /// Embeds crops and texts.
    pub models: &'a ModelDir,
    /// How ONNX Runtime runs models.
    pub session: &'a SessionOptions,
    /// Rasterises the scene.
    pub rasterizer: &'a dyn Rasterizer,
    /// Disturbs masks and vectors, for experiments.
    pub perturbation: Option<&'a dyn Perturbation>,
}

impl<'a> Engines<'a> {
    /// Returns engines without a perturbation.
    pub fn new(models: &'a ModelDir, session: &'a SessionOptions, rasterizer: &'a dyn Rasterizer) -> Self {
        Self { models, session, rasterizer, perturbation: None }
    }
}

/// Changes the masks and vectors of views on their way through the pipeline, for experiments.
///
/// The result must depend on the arguments alone: views come in any order, from any thread.
pub trait Perturbation: Sync {
    /// Returns a text that differs where results differ; it is part of the encode's identity.
    fn identity(&self) -> String;

    /// Returns the changed masks of a view of `size_px`.
    fn masks(&self, view: &str, masks: Vec<Mask>, size_px: [u32; 2]) -> Vec<Mask>;

    /// Changes the unit vectors of a view's masks, `[n][dim]`.
    fn vectors(&self, view: &str, vectors: &mut [f32], dim: usize);
}
