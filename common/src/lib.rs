//! Vocabulary, geometry, file formats and embedding arithmetic shared by the
//! SLAG encoder (cloud) and edge (robot).
//!
//! Frames, units and transform names are defined once, in [`frames`].
//! Nothing here performs network access, runs models or starts threads.
#![forbid(unsafe_code)]

pub mod camera;
pub mod container;
pub mod durable;
pub mod frames;
pub mod gaussians;
pub mod hash;
pub mod manifest;
pub mod npz;
pub mod objects;
pub mod poses;
pub mod shard;
pub mod splat;

pub use camera::{Distortion, Intrinsics, View};
pub use gaussians::Gaussians;
pub use hash::Hash32;
