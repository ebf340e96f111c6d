//! Helpers of several test files; none uses all of them.
#![allow(dead_code, unused_imports, reason = "each test program uses a part")]

pub use slag_test_support::{needs_shared, shared};
