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
    Read {
        /// The operating system's error, with the path.
        cause: std::io::Error,
    },
    #[error("{}: {reason}; fetch tokenizer.json again", path.display())]
    Format {
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    #[error(
        "{}: texts end in token {found:?}, but the model's end token is {expected}; use the model's own tokenizer",
        path.display()
    )]
    OtherVocabulary {
        path: PathBuf,
        /// The end token of the description.
        expected: u32,
        /// The last token of a text, if any.
        found: Option<u32>,
    },
    #[error(
        "{}: has token ids up to {largest}, which the model does not accept ({cause}); use the model's own tokenizer",
        path.display()
    )]
    MoreTokens {
        path: PathBuf,
        /// Its largest id.
        largest: u32,
        /// The model's error for a text with that id.
        cause: Box<SessionError>,
    },
    #[error("{}: {reason}; use other words", path.display())]
    Encode {
        path: PathBuf,
        /// The tokenizer's error.
        reason: String,
    },
}

/// Error of reading a list of phrases.
#[derive(Debug, thiserror::Error)]
pub enum PhrasesError {
    #[error("{cause}; put the file there or correct the description")]
    Read {
        /// The operating system's error, with the path.
        cause: std::io::Error,
    },
    #[error("{}: line {line} is empty; the list needs one phrase a line", path.display())]
    EmptyLine {
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
    #[error("{}: line {line}: the vector of {phrase:?} is zero after centring; remove the phrase", path.display())]
    NoDirection {
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        phrase: String,
    },
}

/// Error of encoding a text or crops.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    #[error("the text is empty; say what to look for")]
    EmptyText,
    #[error("{text:?} is not one of the {n_known} phrases this model knows; {}", suggestion(near))]
    UnknownPhrase {
        /// The normalised text.
        text: String,
        /// Number of known phrases.
        n_known: usize,
        /// Similar known phrases, nearest first.
        near: Vec<String>,
    },
    #[error("the built-in model knows no {}; use words of: {}", unknown.join(", "), known.join(", "))]
    UnknownWords {
        /// The unknown words.
        unknown: Vec<String>,
        /// All known words.
        known: Vec<String>,
    },
    #[error("crop {index} has no pixels to encode; drop empty masks first")]
    EmptyCrop {
        /// Its index among the crops given.
        index: usize,
    },
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error("vector {index} of {model} is zero or not finite; the model file does not fit its description")]
    NoDirection {
        /// The model's name.
        model: String,
        /// Index of the vector.
        index: usize,
    },
    #[error("vector {index} of {model} has length {norm}, expected 1; set image.normalise = true")]
    NotUnit {
        /// The model's name.
        model: String,
        /// Index of the vector.
        index: usize,
        /// Its length.
        norm: f64,
    },
}

fn suggestion(near: &[String]) -> String {
    match near {
        [] => "no known phrase is similar; see its list of phrases".to_owned(),
        _ => format!("did you mean {}?", near.join(", ")),
    }
}
