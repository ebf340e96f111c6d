//! The robot's program, its fetches and its benchmark.

mod bench;
mod binary;
mod fetch;
