//! Errors of ONNX Runtime and of the model files that it runs.

use std::path::PathBuf;

use crate::placement::Placement;
use crate::provider::{Provider, names};

/// Error of opening or running a model.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    #[error("{}: no such ONNX Runtime library; `scripts/get-onnxruntime.sh` downloads one and prints its path, which --runtime takes", path.display())]
    NoRuntime { path: PathBuf },
    #[error(
        "ONNX Runtime: {cause}; version 1.17 or newer is needed: `scripts/get-onnxruntime.sh` downloads it and prints its \
         path, which --runtime takes; beside the program it is found by itself"
    )]
    Runtime { cause: Box<ort::LoadDynamicError> },
    #[error("ONNX Runtime is already loaded from {}, but {} is requested; use one per process", loaded.display(), asked.display())]
    OtherRuntime { loaded: PathBuf, asked: PathBuf },
    #[error("ONNX Runtime does not start: {cause}; check its version (1.17 or newer)")]
    Start { cause: ort::Error },
    #[error(
        "ONNX Runtime cannot use {provider}: {cause}; install its drivers and a libonnxruntime built with it \
         (onnxruntime-gpu for cuda and tensorrt), or allow the CPU as well: {provider},cpu"
    )]
    Provider { provider: Provider, cause: ort::Error },
    #[error(
        "{}: runs on {placement} only, but {} is requested; use another export of the model, or add cpu to \
         allow the CPU as well", path.display(), names(asked)
    )]
    NotPlaced { path: PathBuf, asked: Vec<Provider>, placement: Placement },
    #[error("{cause}; put the model file there or correct the description")]
    Read { cause: std::io::Error },
    #[error("{}: {cause}; fetch the model file again", path.display())]
    Load { path: PathBuf, cause: ort::Error },
    #[error(
        "{}: {cause}; give a newer libonnxruntime, or export the model for an older opset (all support 17)",
        path.display()
    )]
    Version { path: PathBuf, cause: ort::Error },
    #[error("{}: no {role} {name:?}, it has {}; correct the description", path.display(), found.join(", "))]
    NoTensor { path: PathBuf, role: &'static str, name: String, found: Vec<String> },
    #[error(
        "{}: the description names no {role}, and not exactly one of {} is {expected}; name it in the description",
        path.display(), found.join(", ")
    )]
    Unnamed {
        path: PathBuf,
        role: &'static str,
        found: Vec<String>,
        /// Expected type and shape; -1 is any size.
        expected: String,
    },
    #[error("{}: {role} {name:?} is {found}, expected {expected}; correct the description", path.display())]
    Shape {
        path: PathBuf,
        role: &'static str,
        name: String,
        found: String,
        /// Expected type and shape; -1 is any size.
        expected: String,
    },
    #[error("{}: {found}; expected {expected}; use the files of one export, each in its field", path.display())]
    Layout { path: PathBuf, found: String, expected: String },
    #[error("{}: the model fails to run: {cause}; check that the file fits its description", path.display())]
    Run { path: PathBuf, cause: ort::Error },
}
