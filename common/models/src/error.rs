//! Errors of opening and running encoders.

use std::path::PathBuf;

use crate::{description::DescriptionError, session_error::SessionError, tensors::TensorsError};

/// Says why an encoder could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The description is wrong, or a file is not the one that it names.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// ONNX Runtime or a model file is at fault.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The tokenizer is at fault.
    #[error(transparent)]
    Tokenizer(#[from] TokenizerError),
    /// The list of phrases is at fault.
    #[error(transparent)]
    Phrases(#[from] PhrasesError),
    /// A file of tensors is at fault.
    #[error(transparent)]
    Tensors(#[from] TensorsError),
}

/// Says why text could not be made into tokens.
#[derive(Debug, thiserror::Error)]
pub enum TokenizerError {
    /// The file could not be read.
    #[error("{cause}; put the tokenizer there or correct the description")]
    Read {
        /// The operating system's answer, which names the path.
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
    /// The tokenizer is of another model.
    #[error(
        "{}: a text ends in token {found:?}, the model's end token is {expected}; use the model's own tokenizer",
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
    /// The tokenizer has more tokens than the model knows.
    #[error(
        "{}: has token ids up to {largest}, the model does not take them ({cause}); use the model's own tokenizer",
        path.display()
    )]
    MoreTokens {
        /// The file.
        path: PathBuf,
        /// Its largest id.
        largest: u32,
        /// What the model says to a text of it.
        cause: Box<SessionError>,
    },
    /// The tokenizer fails on a text.
    #[error("{}: {reason}; use other words", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// What it says.
        reason: String,
    },
}

/// Says why a list of phrases is refused.
#[derive(Debug, thiserror::Error)]
pub enum PhrasesError {
    /// The file could not be read.
    #[error("{cause}; put the file there or correct the description")]
    Read {
        /// The operating system's answer, which names the path.
        cause: std::io::Error,
    },
    /// A line has no phrase.
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

/// Says why something could not be encoded.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// There is nothing to encode.
    #[error("the text is empty; say what to look for")]
    EmptyText,
    /// The list of phrases has no such phrase.
    #[error("{text:?} is not one of the {n_known} phrases this model knows; {}", suggestion(near))]
    UnknownPhrase {
        /// The text as it was looked up.
        text: String,
        /// How many phrases are known.
        n_known: usize,
        /// Known phrases that look like it, nearest first.
        near: Vec<String>,
    },
    /// The built-in stand-in knows some words only.
    #[error("the built-in model knows no {}; use words of: {}", unknown.join(", "), known.join(", "))]
    UnknownWords {
        /// The words that it does not know.
        unknown: Vec<String>,
        /// All that it knows.
        known: Vec<String>,
    },
    /// A crop has no pixels, or none inside.
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
    /// The model gave a vector without a direction.
    #[error("vector {index} of {model} is zero or not finite; the model file does not fit its description")]
    NoDirection {
        /// The model's name.
        model: String,
        /// Index of the vector.
        index: usize,
    },
    /// The model's vectors are not of unit length though the description says so.
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
        [] => "none is near; ask for its list of phrases".to_owned(),
        _ => format!("did you mean {}?", near.join(", ")),
    }
}
