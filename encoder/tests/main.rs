//! The encoder's tests, except for one that needs its own process.

mod embed;
mod encode;
mod graph;
mod ingest;
mod lift_extremes;
#[cfg(feature = "gpu")]
mod raster;
mod segment;
mod viewpoints;

use std::path::Path;

use glam::{DAffine3, DVec3};
use image::{Rgb, RgbImage};
use slag_common::{Distortion, Gaussians, View, poses};
use slag_encoder::encode::{EncodeSettings, Engines, Masks};
use slag_encoder::ingest::{Undistorter, drawn_from, load_image};
use slag_encoder::masks::{BoxPx, Mask};
use slag_encoder::progress::Silent;
use slag_encoder::raster::{CpuRasterizer, pinhole};
use slag_encoder::segment::{GivenMasks, SegmentInput, Segmenter};
use slag_lab::generate::{Scene, grammar};
use slag_math::random::Random;
use slag_models::{ModelDir, SessionOptions};
use slag_test_support::{assert_error, memory_of, needs_shared, shared};

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
