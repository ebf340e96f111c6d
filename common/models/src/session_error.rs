//! Errors of ONNX Runtime and of the model files that it runs.

use std::path::PathBuf;

use crate::placement::Placement;
use crate::provider::{Provider, names};

/// Error of opening or running a model.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The requested library does not exist.
    #[error("{}: no such ONNX Runtime library; `scripts/get-onnxruntime.sh` downloads one and prints its path, which --runtime takes", path.display())]
    NoRuntime {
        /// Its path.
        path: PathBuf,
    },
    /// The library cannot be loaded.
    #[error(
        "ONNX Runtime: {cause}; version 1.17 or newer is needed: `scripts/get-onnxruntime.sh` downloads it and prints its \
         path, which --runtime takes; beside the program it is found by itself"
    )]
    Runtime {
        /// The loader's error, with the path.
        cause: Box<ort::LoadDynamicError>,
    },
    /// The process has already loaded another library.
    #[error("ONNX Runtime is already loaded from {}, but {} is requested; use one per process", loaded.display(), asked.display())]
    OtherRuntime {
        /// The library in use.
        loaded: PathBuf,
        /// The requested library.
        asked: PathBuf,
    },
    /// ONNX Runtime fails to start.
    #[error("ONNX Runtime does not start: {cause}; check its version (1.17 or newer)")]
    Start {
        /// The runtime's error.
        cause: ort::Error,
    },
    /// A requested accelerator cannot be used.
    #[error(
        "ONNX Runtime cannot use {provider}: {cause}; install its drivers and a libonnxruntime built with it \
         (onnxruntime-gpu for cuda and tensorrt), or allow the CPU as well: {provider},cpu"
    )]
    Provider {
        /// The accelerator.
        provider: Provider,
        /// The runtime's error.
        cause: ort::Error,
    },
    /// None of the requested accelerators runs any part of the model.
    #[error(
        "{}: runs on {placement} only, but {} is requested; use another export of the model, or add cpu to \
         allow the CPU as well", path.display(), names(asked)
    )]
    NotPlaced {
        /// The model file.
        path: PathBuf,
        /// The requested accelerators.
        asked: Vec<Provider>,
        /// Where its nodes run.
        placement: Placement,
    },
    /// The model file cannot be read.
    #[error("{cause}; put the model file there or correct the description")]
    Read {
        /// The operating system's error, with the path.
        cause: std::io::Error,
    },
    /// The model file cannot be loaded: truncated, or not ONNX.
    #[error("{}: {cause}; fetch the model file again", path.display())]
    Load {
        /// The model file.
        path: PathBuf,
        /// The runtime's error.
        cause: ort::Error,
    },
    /// The library does not support the model file's version.
    #[error(
        "{}: {cause}; give a newer libonnxruntime, or export the model for an older opset (all support 17)",
        path.display()
    )]
    Version {
        /// The model file.
        path: PathBuf,
        /// The runtime's error.
        cause: ort::Error,
    },
    /// The model has no such input or output.
    #[error("{}: no {role} {name:?}, it has {}; correct the description", path.display(), found.join(", "))]
    NoTensor {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// The name in the description.
        name: String,
        /// The model's names.
        found: Vec<String>,
    },
    /// An input or output is not named in the description, and not exactly one fits.
    #[error(
        "{}: the description names no {role}, and not exactly one of {} is {expected}; name it in the description",
        path.display(), found.join(", ")
    )]
    Unnamed {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// The model's inputs or outputs, with types and shapes.
        found: Vec<String>,
        /// Expected type and shape; -1 is any size.
        expected: String,
    },
    /// An input or output has an unexpected type or shape.
    #[error("{}: {role} {name:?} is {found}, expected {expected}; correct the description", path.display())]
    Shape {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// Its name.
        name: String,
        /// Its type and shape.
        found: String,
        /// Expected type and shape; -1 is any size.
        expected: String,
    },
    /// The model's inputs or outputs are not those of its kind.
    #[error("{}: {found}; expected {expected}; use the files of one export, each in its field", path.display())]
    Layout {
        /// The model file.
        path: PathBuf,
        /// The layout found.
        found: String,
        /// The layout expected.
        expected: String,
    },
    /// Running the model failed.
    #[error("{}: the model fails to run: {cause}; check that the file fits its description", path.display())]
    Run {
        /// The model file.
        path: PathBuf,
        /// The runtime's error.
        cause: ort::Error,
    },
}
