//! Last stage: makes a scene available, over HTTP to robots and as points to a Qdrant database.

pub mod geographic;
pub mod qdrant;
pub mod serve;
