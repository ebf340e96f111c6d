use crate::{
    description::DescriptionError, phrases::PhrasesError, session::SessionError, tensors::TensorsError,
    text::TokenizerError,
};

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
