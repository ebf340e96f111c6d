//! Scenes that the project makes itself, from a seed: Gaussians, photos, poses, and what is true about them.
//!
//! Things are made by the rules of their nouns' files ([`grammar`]), stand in rooms, yards and streets
//! ([`compose`]), and are photographed by casting rays ([`render`]); the Gaussians cover the same surfaces.

pub mod compose;
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
pub(crate) use output::to_image;
pub use scene::{Scene, TrueObject, WrittenScene};
