//! Finds the camera of a photo in a map of landmarks, without a GPU, a network or a model.
//!
//! [`features`] (SIFT) become codes of 128 bits ([`code`]). Those of mapping photos, with depths from the splat,
//! make the map ([`build()`]); those of a photo are matched with it, and the answer is the pose with most inliers
//! ([`locate`]). A rendering of the scene at that pose ([`Renderer`]) verifies and improves it by features or,
//! where the splat is too blurred, by patches.
#![forbid(unsafe_code)]

mod build;
mod describe;
mod features;
mod find;
mod grey;
mod map;
mod matching;
mod patches;
mod pose;
mod ransac;
mod render;

pub use build::{MappingView, Observation, WORKING_BYTES_PER_OBSERVATION, build};
pub use describe::{DIM, Descriptor};
pub use features::{Feature, MAX_FEATURES, features, working_bytes};
pub use find::{Located, Outcome, Photo, Prior, Reason, locate};
pub use grey::Grey;
pub use map::{CODE_VERSION, Code, Map, code, map_bytes};
pub use pose::Pinhole;
pub use ransac::p3p;
pub use render::{Renderer, Rendering, point_in_world};
pub use slag_common::landmarks::Landmark;
