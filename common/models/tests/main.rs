//! Models of all kinds, but for the loading of ONNX Runtime.

mod bad_input;
mod clip;
mod colours;
mod common;
mod conse;
mod dense;
mod encoders;
mod hub;
mod sam;
mod sam2;
mod siglip2;

use std::path::Path;

use image::{Rgb, RgbImage};
use slag_models::preprocess::{Filter, Preprocess, Resize};
use slag_models::sam::{Letterbox, Sam};
use slag_models::text::Tokens;
use slag_models::{Crop, InferenceError, ModelDir, SessionOptions};
use slag_test_support::assert_error;
use tempfile::TempDir;

use common::{
    array, assert_recorded, image, link_models, max_difference, model_dir, needs_shared, options, shared,
    unhashed, unit,
};
