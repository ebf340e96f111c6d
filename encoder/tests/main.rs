//! The encoder's tests, except for one that needs its own process.

mod embed;
mod encode;
mod graph;
mod ingest;
mod lift_extremes;
#[cfg(feature = "gpu")]
mod raster;
mod segment;
mod viewpoints;

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
