//! What several test files use.

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
