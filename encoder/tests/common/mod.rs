//! What several test files use, not each of them all of it.
#![allow(dead_code, unused_imports, reason = "each test program uses a part")]

pub use slag_test_support::{needs_shared, shared};

/// Deterministic random numbers (SplitMix64; Steele, Lea and Flood 2014).
pub struct Random(pub u64);

impl Random {
    /// Returns a number less than `n`.
    pub fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % n as u64) as usize
    }
}
