//! Formats and geometry.

mod appearance;
mod fine;
mod format_doc;
mod poses;
mod scannet;
mod splat;
mod tuf;

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
