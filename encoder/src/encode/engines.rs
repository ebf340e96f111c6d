//! What does the work of an encode.

use slag_models::{ModelDir, SessionOptions};

use crate::raster::Rasterizer;

/// The models, and what rasterises.
#[derive(Clone, Copy)]
pub struct Engines<'a> {
    /// Embeds crops and texts.
    pub models: &'a ModelDir,
    /// How ONNX Runtime runs models.
    pub session: &'a SessionOptions,
    pub rasterizer: &'a dyn Rasterizer,
}

impl<'a> Engines<'a> {
    pub fn new(models: &'a ModelDir, session: &'a SessionOptions, rasterizer: &'a dyn Rasterizer) -> Self {
        Self { models, session, rasterizer }
    }
}
