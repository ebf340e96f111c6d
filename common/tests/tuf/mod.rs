//! The attacks that TUF names, each against a client that has updated once; repositories of other TUF programs.

mod attacks;

mod recovery;
mod repo;

use std::collections::BTreeMap;

use slag_common::tuf::{FileMeta, Kept, Key, Snapshot, Targets, TufError, refresh, sign};
