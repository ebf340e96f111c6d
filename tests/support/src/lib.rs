//! Shared by tests of several crates: test data beside the project, and an allocator that counts.
//!
//! Scenes and models that are too large for the repository are in `../shared`, or in the folder `SLAG_SHARED`.
//! Tests that use them are [`needs_shared`] instead of `test`: without the data, `cargo test` lists them as ignored; in CI
//! they run and fail. Tests that take minutes and guard against rare faults are marked with [`nightly`].

mod loop_disk;
mod memory;

use std::path::{Path, PathBuf};

pub use loop_disk::{BLOCK_BYTES, LoopDisk};
pub use memory::{CountingAllocator, Taken, memory_of};
pub use slag_test_needs::{needs_loop_disk, needs_shared, nightly};

/// Number of trials: `few`, or `many` in the nightly checks.
pub fn trials<T>(few: T, many: T) -> T {
    if is_nightly() { many } else { few }
}

pub fn is_nightly() -> bool {
    std::env::var_os("SLAG_NIGHTLY").is_some()
}

pub fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The folder of the shared test data, if it exists.
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

/// Asserts that the message of an error has all these parts: place, fault, advice.
#[track_caller]
pub fn assert_error<T>(result: Result<T, impl ToString>, parts: &[&str]) {
    let message = result.err().map(|error| error.to_string());
    let message = message.unwrap_or_else(|| panic!("no error, expected one with {parts:?}"));
    assert!(parts.iter().all(|part| message.contains(part)), "{message}, expected {parts:?}");
}

/// Returns the shape and the elements of an array in an npz file.
pub fn npz_array<T: npyz::Deserialize>(npz: &Path, name: &str) -> (Vec<usize>, Vec<T>) {
    let file = std::fs::File::open(npz).expect("the npz is there");
    let mut archive = zip::ZipArchive::new(file).expect("the npz opens");
    let member = archive.by_name(&format!("{name}.npy")).unwrap_or_else(|_| panic!("no array {name}"));
    let array = npyz::NpyFile::new(member).expect("an array");
    let shape = array.shape().iter().map(|&n| n as usize).collect();
    (shape, array.into_vec().expect("elements are of that type"))
}

/// The ONNX Runtime library that `scripts/setup.sh` installs.
pub fn onnx_runtime() -> PathBuf {
    let library = format!("target/onnxruntime/{}/libonnxruntime.so", std::env::consts::ARCH);
    let library = workspace_root().join(library);
    assert!(library.exists(), "{} does not exist: run scripts/setup.sh", library.display());
    library
}
