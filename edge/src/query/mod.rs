//! From a question to ranked answers.

pub mod cluster;
