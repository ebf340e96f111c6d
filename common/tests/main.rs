//! Formats and geometry.

mod appearance;
mod fine;
mod format_doc;
mod poses;
mod scannet;
mod splat;
mod tuf;

use std::path::Path;

use glam::{DMat3, DVec3};
use slag_common::container;
use slag_common::container::AlignedBytes;
use slag_common::frames::Aabb;
use slag_common::poses::PoseSource;
use slag_common::shard::sample::SampleShard;
use slag_common::shard::{ShardHeader, ShardLayout, sample, section};
use slag_test_support::assert_error;

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
