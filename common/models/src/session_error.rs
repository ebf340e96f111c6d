//! Errors of ONNX Runtime and of the model files that it runs.

use std::path::PathBuf;

use crate::placement::Placement;
use crate::provider::{Provider, names};

/// Says why a model could not be opened or run.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The library asked for is not there.
    #[error("{}: no such ONNX Runtime library; give the path of libonnxruntime.so (1.17 or newer)", path.display())]
    NoRuntime {
        /// Where it was expected.
        path: PathBuf,
    },
    /// The library does not load.
    #[error(
        "ONNX Runtime: {cause}; install version 1.17 or newer, put libonnxruntime.so beside the program, or give its path"
    )]
    Runtime {
        /// What the loader says; it names the path.
        cause: Box<ort::LoadDynamicError>,
    },
    /// Another library was loaded before.
    #[error("ONNX Runtime is loaded from {}, {} was asked for; use one per process", loaded.display(), asked.display())]
    OtherRuntime {
        /// The library in use.
        loaded: PathBuf,
        /// The library asked for.
        asked: PathBuf,
    },
    /// The library refuses to start.
    #[error("ONNX Runtime does not start: {cause}; check its version (1.17 or newer)")]
    Start {
        /// What it says.
        cause: ort::Error,
    },
    /// The accelerator asked for cannot be used.
    #[error(
        "ONNX Runtime cannot use {provider}: {cause}; give a libonnxruntime that is built with it, with its drivers \
         (onnxruntime-gpu for cuda and tensorrt), or let the processor stand in: {provider},cpu"
    )]
    Provider {
        /// The accelerator.
        provider: Provider,
        /// What the runtime says.
        cause: ort::Error,
    },
    /// The accelerators asked for take no part of the model.
    #[error(
        "{}: runs on {placement} alone, {} was asked for; use another export of the model, or let the processor \
         stand in by adding cpu", path.display(), names(asked)
    )]
    NotPlaced {
        /// The model file.
        path: PathBuf,
        /// What was asked for.
        asked: Vec<Provider>,
        /// What runs it.
        placement: Placement,
    },
    /// The model file cannot be read.
    #[error("{cause}; put the model file there or correct the description")]
    Read {
        /// The operating system's answer, which names the path.
        cause: std::io::Error,
    },
    /// The model file cannot be loaded: cut, not ONNX, or of an unknown version.
    #[error("{}: {cause}; fetch the model file again", path.display())]
    Load {
        /// The model file.
        path: PathBuf,
        /// What the runtime says.
        cause: ort::Error,
    },
    /// The model file is of a version that the library does not know.
    #[error(
        "{}: {cause}; give a newer libonnxruntime, or export the model for an older opset (17 is known to all)",
        path.display()
    )]
    Version {
        /// The model file.
        path: PathBuf,
        /// What the runtime says.
        cause: ort::Error,
    },
    /// The model has no such input or output.
    #[error("{}: no {role} {name:?}, it has {}; correct the description", path.display(), found.join(", "))]
    NoTensor {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// The name asked for.
        name: String,
        /// The names that it has.
        found: Vec<String>,
    },
    /// Which input or output is meant is not clear.
    #[error(
        "{}: the {role} is not named, and of {} not one alone is {expected}; name it in the description",
        path.display(), found.join(", ")
    )]
    Unnamed {
        /// The model file.
        path: PathBuf,
        /// "input" or "output".
        role: &'static str,
        /// All that it has, with types and shapes.
        found: Vec<String>,
        /// Type and shape looked for; -1 is any size.
        expected: String,
    },
    /// An input or output is of another type or shape.
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
        /// What is expected; -1 is any size.
        expected: String,
    },
    /// The model is of another layout.
    #[error("{}: {found}; expected {expected}; give the files of one export in their places", path.display())]
    Layout {
        /// The model file.
        path: PathBuf,
        /// What it has.
        found: String,
        /// What is expected.
        expected: String,
    },
    /// Running the model failed.
    #[error("{}: running the model: {cause}; the file does not fit its description", path.display())]
    Run {
        /// The model file.
        path: PathBuf,
        /// What the runtime says.
        cause: ort::Error,
    },
}
