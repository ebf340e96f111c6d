//! Keeps the shards around a robot and answers text queries from them, offline.

pub mod query;
pub mod score;
#[cfg(test)]
mod testing;
