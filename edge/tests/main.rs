//! The robot's program and its fetches.

mod binary;
mod fetch;
