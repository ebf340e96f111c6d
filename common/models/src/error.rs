//! Errors of opening and running encoders.

use std::path::PathBuf;

use crate::{description::DescriptionError, session_error::SessionError, tensors::TensorsError};

/// Error of opening an encoder.
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

/// Error of turning text into tokens.
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
        /// The last token of a text, if any.
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

/// Error of reading a list of phrases.
#[derive(Debug, thiserror::Error)]
pub enum PhrasesError {
    #[error("{cause}; put the file there or correct the description")]
    Read { cause: std::io::Error },
    #[error("{}: line {line} is empty; the list needs one phrase a line", path.display())]
    EmptyLine { path: PathBuf, line: usize },
    #[error("{}: line {line}: the vector of {phrase:?} is zero after centring; remove the phrase", path.display())]
    NoDirection { path: PathBuf, line: usize, phrase: String },
}

/// Error of encoding a text or crops.
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
