//! What does the work of an encode.

use slag_models::{ModelDir, SessionOptions};

use crate::raster::Rasterizer;

#[derive(Clone, Copy)]
pub struct Engines<'a> {
    pub models: &'a ModelDir,
    pub session: &'a SessionOptions,
    pub rasterizer: &'a dyn Rasterizer,
}

impl<'a> Engines<'a> {
    pub fn new(models: &'a ModelDir, session: &'a SessionOptions, rasterizer: &'a dyn Rasterizer) -> Self {
        Self { models, session, rasterizer }
    }
}
