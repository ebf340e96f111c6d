//! Splat files: values recorded with other readers, and our own oracles.

mod formats;
mod generated;
mod memory;
mod ply_variants;

use std::io::Write;
use std::path::Path;

use slag_common::Gaussians;
use slag_common::splat::{ReadOptions, SplatError, read};
use slag_test_support::{assert_error, needs_shared, shared};

use generated::gzip;

fn read_all(path: &Path) -> Result<Gaussians, SplatError> {
    read(path, &ReadOptions { with_sh_rest: true })
}

fn read_bytes(name: &str, bytes: &[u8]) -> Result<Gaussians, SplatError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).expect("the temporary folder can be written");
    read_all(&path)
}

#[track_caller]
fn read_well(name: &str, bytes: &[u8]) -> Gaussians {
    read_bytes(name, bytes).unwrap_or_else(|error| panic!("{error}"))
}

/// Asserts that the error has all these parts.
#[track_caller]
fn refused(name: &str, bytes: &[u8], parts: &[&str]) {
    let error = read_bytes(name, bytes).expect_err("is refused").to_string();
    assert!(parts.iter().all(|part| error.contains(part)), "{error}, expected {parts:?}");
}

fn assert_columns_agree(gaussians: &Gaussians) {
    let n = gaussians.len();
    let rest = n * 3 * Gaussians::sh_rest_per_channel(gaussians.sh_degree);
    let lengths = [
        gaussians.rotations_wxyz.len(),
        gaussians.scales.len(),
        gaussians.opacities.len(),
        gaussians.sh_dc.len(),
    ];
    assert_eq!((lengths, gaussians.sh_rest.len()), ([n; 4], rest));
}

/// Relative to 1, or to the value if larger.
#[track_caller]
fn assert_near(found: f64, expected: f64, tolerance: f64, what: &str) {
    let error = (found - expected).abs() / expected.abs().max(1.0);
    assert!(error <= tolerance, "{what}: found {found}, expected {expected}");
}
