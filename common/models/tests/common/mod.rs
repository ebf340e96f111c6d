//! Where the tests' data lies.
#![allow(dead_code, reason = "each test program uses a part")]

pub mod made;
pub mod onnx;

use std::path::{Path, PathBuf};

use slag_common::npz::Npz;
use slag_models::SessionOptions;

/// The project's root.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// A model directory of the project's tests.
pub fn model_dir(name: &str) -> PathBuf {
    root().join("tests/models").join(name)
}

fn present(path: PathBuf, message: &str) -> Option<PathBuf> {
    let is_there = path.exists();
    if !is_there {
        assert!(std::env::var("CI").as_deref() != Ok("true"), "{message}");
        println!("skipped: {message}");
    }
    is_there.then_some(path)
}

/// A path in the shared test data, if that is there.
pub fn shared(path: &str) -> Option<PathBuf> {
    let shared = std::env::var_os("SLAG_SHARED").map_or_else(|| root().join("../shared"), PathBuf::from);
    present(shared, "../shared is absent").map(|shared| shared.join(path))
}

/// Sessions on the library that `scripts/get-onnxruntime.sh` puts into `target`, if it is there.
pub fn options() -> Option<SessionOptions> {
    let library = format!("target/onnxruntime/{}/libonnxruntime.so", std::env::consts::ARCH);
    present(root().join(library), "no ONNX Runtime: run scripts/get-onnxruntime.sh").map(SessionOptions::new)
}

/// An array of an npz file: its shape and elements.
pub fn array<T: npyz::Deserialize>(npz: &Path, name: &str) -> (Vec<usize>, Vec<T>) {
    let mut archive = Npz::open(npz).expect("the npz opens");
    let member = archive.array(name).expect("it is readable").unwrap_or_else(|| panic!("no array {name}"));
    let array = npyz::NpyFile::new(member).expect("an array");
    let shape = array.shape().iter().map(|&n| n as usize).collect();
    (shape, array.into_vec().expect("elements are of that type"))
}

/// An image `[height][width][3]` of an npz file.
pub fn image(npz: &Path, name: &str) -> image::RgbImage {
    let (shape, levels) = array::<u8>(npz, name);
    image::RgbImage::from_raw(shape[1] as u32, shape[0] as u32, levels).expect("it is RGB")
}

/// The vector scaled to unit length, in f64.
pub fn unit(vector: &[f32]) -> Vec<f64> {
    let norm = vector.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
    vector.iter().map(|&x| f64::from(x) / norm).collect()
}

/// The largest absolute difference.
pub fn max_difference(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, b)| (f64::from(a) - b).abs()).fold(0.0, f64::max)
}
