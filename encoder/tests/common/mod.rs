//! What several test files use, not each of them all of it.
#![allow(dead_code, unused_imports, reason = "each test program uses a part")]

pub use slag_test_support::{needs_shared, shared};
