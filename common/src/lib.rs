//! Geometry and file formats shared by the SLAG encoder (cloud) and edge (robot).
//!
//! [`frames`] defines coordinate frames, units and the names of transforms.
//! Nothing here accesses the network, runs models or starts threads.
#![forbid(unsafe_code)]

pub mod appearance;
pub mod byte_size;
pub mod camera;
pub mod container;
pub mod durable;
mod error_line;
pub mod files;
pub mod frames;
pub mod gaussians;
pub mod hash;
pub mod landmarks;
pub mod manifest;
mod named_members;
pub mod npy;
pub mod objects;
pub mod occupancy;
pub mod photo;
pub mod photo_poses;
pub mod poses;
mod quantise;
pub mod retry;
pub mod shard;
pub mod similarity;
pub mod splat;
mod stderr;
pub mod tuf;

pub use byte_size::ByteSize;
pub use camera::{Distortion, Intrinsics, View, pinhole};
pub use error_line::error_line;
pub use gaussians::Gaussians;
pub use hash::Hash32;
pub use similarity::Similarity;
pub use stderr::note;
