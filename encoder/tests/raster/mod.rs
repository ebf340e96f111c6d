//! The rasteriser and the scene check against recorded data and a brute-force oracle.

mod backends;
mod brute_force;
mod check;
mod extremes;
mod fixtures;
mod frames;
mod gpu;
mod gsplat;
mod oracle;
mod rejected;
mod scenes;
mod table;

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use slag_common::splat::ReadOptions;
use slag_common::{Distortion, Gaussians, Intrinsics, View, pinhole, poses, splat};
use slag_encoder::check::{CheckOptions, CheckReport, CheckView, FrameCause, Mistake};
use slag_encoder::masks::{NO_REGION, RegionMap};
use slag_encoder::raster::gpu::{GpuOptions, GpuRasterizer, adapters};
use slag_encoder::raster::{
    CpuRasterizer, Drawing, LoadedScene, RasterError, RasterView, Rasterizer, ViewWeights,
};
use slag_math::random::Random;
use slag_test_support::assert_error;

use backends::Backend;
use fixtures::{needs_shared, photo, read_splat, shared, shrunk};
use scenes::{SceneRandom, posed, push, random_regions, random_scene, random_view, unproject};
use table::{Case, Row};
