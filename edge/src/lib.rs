//! The robot's side of SLAG: keeps the shards around it and answers text queries offline.

pub mod fetch;
pub mod store;
