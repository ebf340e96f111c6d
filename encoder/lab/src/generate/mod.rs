//! Scenes generated from a seed: Gaussians, photos, poses and labels.
//!
//! Object files hold the rules by which things are made ([`grammar`]). Things stand in rooms, yards and streets
//! ([`compose`]) and are photographed by ray casting ([`render`]); the Gaussians cover the same surfaces.

pub(crate) mod compose;
pub(crate) mod copies;
pub(crate) mod crops;
mod expression;
pub mod grammar;
pub(crate) mod paint;
pub(crate) mod photos;
pub(crate) mod render;
mod scene;
mod solid;

pub(crate) use scene::TrueObject;
pub use scene::{Scene, WrittenScene};
