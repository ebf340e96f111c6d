//! Last stage: serves a scene to robots over HTTP, and pushes it as points to Qdrant.

pub(crate) mod geographic;
#[cfg(feature = "qdrant")]
pub mod qdrant;
pub mod serve;
