//! What tests of several crates share: the test data beside the project, and an allocator that counts.
//!
//! Some tests use scenes and models that are too large for the repository. They lie in `../shared`, or in the
//! folder that `SLAG_SHARED` names. Mark such a test with [`needs_shared`]: where the data is absent, `cargo test`
//! lists the test as ignored; in CI it runs and fails. Tests that take minutes and guard against rare faults are
//! marked with [`nightly`].

mod loop_disk;
mod memory;

use std::path::{Path, PathBuf};

pub use loop_disk::{BLOCK_BYTES, LoopDisk};
pub use memory::{CountingAllocator, Taken, memory_of};
pub use slag_test_needs::{needs_loop_disk, needs_shared, nightly};

/// Returns how often a test tries: `few` times, or `many` in the nightly checks.
pub fn trials<T>(few: T, many: T) -> T {
    if is_nightly() { many } else { few }
}

pub fn is_nightly() -> bool {
    std::env::var_os("SLAG_NIGHTLY").is_some()
}

pub fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Returns the folder of the shared test data, or `None` where it is absent.
pub fn shared_folder() -> Option<PathBuf> {
    let folder = std::env::var_os("SLAG_SHARED");
    let folder = folder.map_or_else(|| workspace_root().join("../shared"), PathBuf::from);
    folder.is_dir().then_some(folder)
}

/// Returns the path of a file or folder in the shared test data.
///
/// # Panics
/// If it does not exist. Tests that call this are marked with [`needs_shared`].
pub fn shared(path: &str) -> PathBuf {
    let folder = shared_folder().expect("../shared or SLAG_SHARED holds the test data");
    let found = folder.join(path);
    assert!(found.exists(), "{} is missing from the test data", found.display());
    found
}

/// Returns the path of the ONNX Runtime library that `scripts/setup.sh` installs.
pub fn onnx_runtime() -> PathBuf {
    let library = format!("target/onnxruntime/{}/libonnxruntime.so", std::env::consts::ARCH);
    let library = workspace_root().join(library);
    assert!(library.exists(), "{} does not exist: run scripts/setup.sh", library.display());
    library
}
