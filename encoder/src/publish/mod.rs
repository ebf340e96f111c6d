//! Last stage: serves a scene to robots over HTTP, and pushes it as points to a Qdrant database.

pub(crate) mod geographic;
#[cfg(feature = "qdrant")]
pub mod qdrant;
pub mod serve;
