//! What several test files use, not each of them all of it.
#![allow(dead_code)]

use std::path::PathBuf;

/// Returns a path in the shared test data; `None`, said aloud, where that is absent outside CI.
pub fn shared(path: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SLAG_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    let full = root.join(path);
    if full.exists() {
        return Some(full);
    }
    assert!(std::env::var("CI").as_deref() != Ok("true"), "{} is absent in CI", full.display());
    println!("skipped: ../shared is absent");
    None
}

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
