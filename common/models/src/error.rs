//! Errors of opening and running encoders.

use std::path::PathBuf;

use crate::{description::DescriptionError, session_error::SessionError, tensors::TensorsError};

/// Error of opening an encoder.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The description is invalid, or a file differs from the one described.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// Error of ONNX Runtime or a model file.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// Error of the tokenizer.
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    /// Error of the list of phrases.
    #[error(transparent)]
    Phrases(#[from] PhrasesError),
    /// Error of a file of tensors.
    #[error(transparent)]
    Tensors(#[from] TensorsError),
}

/// Error of turning text into tokens.
#[derive(Debug, thiserror::Error)]
pub enum TokenizerError {
    /// The file could not be read.
    #[error("{cause}; put the tokenizer there or correct the description")]
    Read {
        /// The operating system's error, with the path.
        cause: std::io::Error,
    },
    /// The file is not a tokenizer.
    #[error("{}: {reason}; fetch tokenizer.json again", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The tokenizer belongs to another model.
    #[error(
        "{}: texts end in token {found:?}, but the model's end token is {expected}; use the model's own tokenizer",
        path.display()
    )]
    OtherVocabulary {
        /// The file.
        path: PathBuf,
        /// The end token of the description.
        expected: u32,
        /// The last token of a text, if any.
        found: Option<u32>,
    },
    /// The tokenizer has more tokens than the model.
    #[error(
        "{}: has token ids up to {largest}, which the model does not accept ({cause}); use the model's own tokenizer",
        path.display()
    )]
    MoreTokens {
        /// The file.
        path: PathBuf,
        /// Its largest id.
        largest: u32,
        /// The model's error for a text with that id.
        cause: Box<SessionError>,
    },
    /// The tokenizer failed on a text.
    #[error("{}: {reason}; use other words", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// The tokenizer's error.
        reason: String,
    },
}

/// Error of reading a list of phrases.
#[derive(Debug, thiserror::Error)]
pub enum PhrasesError {
    /// The file could not be read.
    #[error("{cause}; put the file there or correct the description")]
    Read {
        /// The operating system's error, with the path.
        cause: std::io::Error,
    },
    /// A line is empty.
    #[error("{}: line {line} is empty; the list needs one phrase a line", path.display())]
    EmptyLine {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
    /// A phrase's vector has no direction.
    #[error("{}: line {line}: the vector of {phrase:?} is zero after centring; remove the phrase", path.display())]
    NoDirection {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The phrase.
        phrase: String,
    },
}

/// Error of encoding a text or crops.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    /// The text is empty.
    #[error("the text is empty; say what to look for")]
    EmptyText,
    /// The text is not in the list of phrases.
    #[error("{text:?} is not one of the {n_known} phrases this model knows; {}", suggestion(near))]
    UnknownPhrase {
        /// The normalised text.
        text: String,
        /// Number of known phrases.
        n_known: usize,
        /// Similar known phrases, nearest first.
        near: Vec<String>,
    },
    /// The built-in stand-in does not know a word.
    #[error("the built-in model knows no {}; use words of: {}", unknown.join(", "), known.join(", "))]
    UnknownWords {
        /// The unknown words.
        unknown: Vec<String>,
        /// All known words.
        known: Vec<String>,
    },
    /// A crop has no pixels, or none inside its mask.
    #[error("crop {index} has no pixels to encode; drop empty masks first")]
    EmptyCrop {
        /// Its index among the crops given.
        index: usize,
    },
    /// The text could not be tokenised.
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    /// The model failed.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The model returned a zero or non-finite vector.
    #[error("vector {index} of {model} is zero or not finite; the model file does not fit its description")]
    NoDirection {
        /// The model's name.
        model: String,
        /// Index of the vector.
        index: usize,
    },
    /// The model's vectors are not of unit length, contrary to the description.
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
