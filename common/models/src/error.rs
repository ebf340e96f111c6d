//! Errors of opening and running encoders.

use std::path::PathBuf;

use crate::description::DescriptionError;
use crate::placement::Placement;
use crate::provider::{Provider, names};
use crate::tensors::TensorsError;

#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error(transparent)]
    Description(#[from] DescriptionError),
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    #[error(transparent)]
    Phrases(#[from] PhrasesError),
    #[error(transparent)]
    Tensors(#[from] TensorsError),
}

#[derive(Debug, thiserror::Error)]
pub enum TokenizerError {
    #[error("{cause}; put the tokenizer there or correct the description")]
    Read { cause: std::io::Error },
    #[error("{}: {reason}; fetch tokenizer.json again", path.display())]
    Format { path: PathBuf, reason: String },
    #[error(
        "{}: texts end in token {found:?}, but the model's end token is {expected}; use the model's own tokenizer",
        path.display()
    )]
    OtherVocabulary {
        path: PathBuf,
        expected: u32,
        /// Last token of a text, if any.
        found: Option<u32>,
    },
    #[error(
        "{}: has token ids up to {largest}, which the model does not accept ({cause}); use the model's own tokenizer",
        path.display()
    )]
    MoreTokens { path: PathBuf, largest: u32, cause: Box<SessionError> },
    #[error("{}: {reason}; use other words", path.display())]
    Encode { path: PathBuf, reason: String },
}

#[derive(Debug, thiserror::Error)]
pub enum PhrasesError {
    #[error("{cause}; put the file there or correct the description")]
    Read { cause: std::io::Error },
    #[error("{}: line {line} is empty; the list needs one phrase a line", path.display())]
    EmptyLine { path: PathBuf, line: usize },
    #[error("{}: line {line}: the vector of {phrase:?} is zero after centring; remove the phrase", path.display())]
    NoDirection { path: PathBuf, line: usize, phrase: String },
}

#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    #[error("the text names nothing; say what to look for")]
    EmptyText,
    #[error("{text:?} is not one of the {n_known} phrases this model knows; {}", suggestion(near))]
    UnknownPhrase {
        text: String,
        n_known: usize,
        /// Similar known phrases, nearest first.
        near: Vec<String>,
    },
    #[error("the built-in model knows no {}; use words of: {}", unknown.join(", "), known.join(", "))]
    UnknownWords { unknown: Vec<String>, known: Vec<String> },
    #[error("crop {index} has no pixels to encode; drop empty masks first")]
    EmptyCrop { index: usize },
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("vector {index} of {model} is zero or not finite; the model file does not fit its description")]
    NoDirection { model: String, index: usize },
    #[error("vector {index} of {model} has length {norm}, expected 1; set image.normalise = true")]
    NotUnit { model: String, index: usize, norm: f64 },
}

fn suggestion(near: &[String]) -> String {
    match near {
        [] => "no known phrase is similar; see its list of phrases".to_owned(),
        _ => format!("did you mean {}?", near.join(", ")),
    }
}

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
