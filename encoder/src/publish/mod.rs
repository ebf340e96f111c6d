//! Last stage: makes a scene available, over HTTP to robots and as points to a Qdrant database.

pub mod geographic;
#[cfg(feature = "qdrant")]
pub mod qdrant;
pub mod serve;
