//! The tests' data.
#![allow(dead_code, unused_imports, reason = "each test program uses a part")]

pub mod made;
pub mod onnx;

use std::path::{Path, PathBuf};

use slag_models::SessionOptions;
pub use slag_test_support::{needs_shared, npz_array as array, shared, workspace_root};

pub fn model_dir(name: &str) -> PathBuf {
    workspace_root().join("tests/models").join(name)
}

/// Sessions on the ONNX Runtime that `scripts/setup.sh` installs.
pub fn options() -> SessionOptions {
    SessionOptions::new(slag_test_support::onnx_runtime())
}

/// An image `[height][width][3]` of an npz file.
pub fn image(npz: &Path, name: &str) -> image::RgbImage {
    let (shape, levels) = array::<u8>(npz, name);
    image::RgbImage::from_raw(shape[1] as u32, shape[0] as u32, levels).expect("it is RGB")
}

pub fn unit(vector: &[f32]) -> Vec<f64> {
    let norm = vector.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
    vector.iter().map(|&x| f64::from(x) / norm).collect()
}

/// Compares vectors of `dim` components with recorded ones, which need not be of unit length.
pub fn assert_recorded(found: &[f32], recorded: &[f32], dim: usize, tolerance: f64) {
    assert_eq!(found.len(), recorded.len());
    for (k, (found, recorded)) in found.chunks_exact(dim).zip(recorded.chunks_exact(dim)).enumerate() {
        let difference = max_difference(found, &unit(recorded));
        assert!(difference < tolerance, "vector {k}: {difference}");
    }
}

/// The largest difference between every `step`th row and column of `found`, `[planes][rows][columns]`, and the
/// recorded values. Planes have a multiple of `step` rows.
pub fn max_difference_of_planes(found: &[f32], columns: usize, step: usize, recorded: &[f32]) -> f64 {
    let rows = found.chunks_exact(columns).enumerate();
    let taken = rows.filter(|(row, _)| row % step == 0).flat_map(|(_, row)| row.iter().step_by(step));
    let pairs: Vec<_> = taken.zip(recorded).collect();
    assert_eq!(pairs.len(), recorded.len());
    pairs.iter().map(|(found, recorded)| f64::from(**found - **recorded).abs()).fold(0.0, f64::max)
}

/// Links the models of the test data into a folder, as `models`.
pub fn link_models(folder: &Path) {
    let models = shared("models").canonicalize().expect("it exists");
    std::os::unix::fs::symlink(models, folder.join("models")).expect("a link");
}

/// A description without the hashes of its files, which would reveal every change.
pub fn unhashed(description: &str) -> String {
    let line = |line: &str| match line.split_once(", sha256") {
        Some((kept, _)) => format!("{kept} }}\n"),
        None => format!("{line}\n"),
    };
    description.lines().map(line).collect()
}

pub fn max_difference(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, b)| (f64::from(a) - b).abs()).fold(0.0, f64::max)
}
