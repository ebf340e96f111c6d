//! All end-to-end tests in one program: it is linked once, and its tests share what they encode.

mod api;
mod cases;
mod doc_tests;
mod doors;
mod drone;
mod export;
mod fleet;
mod found;
mod fuzz;
mod house;
mod keys;
mod kill;
mod layers;
mod locate;
mod manual;
mod page;
mod poison;
mod python_tuf;
mod repair;
mod room;
mod sam;
mod store_bytes;
mod text_model;
mod tls;
mod versions;
mod views;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use clap::CommandFactory;
use glam::DVec3;
use serde_json::{Value, json};
use slag_common::container::AlignedBytes;
use slag_common::shard::{Profile, ShardLayout};
use slag_common::splat;
use slag_common::splat::ReadOptions;
use slag_encoder::lift::field::{read_field, read_regions};
use slag_encoder::store::StoreReader;
use slag_math::random::Random;
use slag_tests::{root, sources};
use syn::visit;
use syn::visit::Visit;

#[global_allocator]
static ALLOCATOR: slag_test_support::CountingAllocator = slag_test_support::CountingAllocator;
