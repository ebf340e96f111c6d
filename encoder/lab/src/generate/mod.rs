//! Scenes generated from a seed: Gaussians, photos, poses and labels.
//!
//! Object files hold the rules by which things are made ([`grammar`]). Things stand in rooms, yards and streets
//! ([`compose`]) and are photographed by ray casting ([`render`]); the Gaussians cover the same surfaces.

pub mod compose;
pub mod copies;
pub mod crops;
mod expression;
pub mod field;
pub mod grammar;
mod output;
pub mod paint;
pub mod photos;
pub mod render;
mod scene;
mod solid;

pub use output::GenerateError;
pub use scene::{Scene, TrueObject, WrittenScene};
