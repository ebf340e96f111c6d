//! Errors of opening and running encoders.

use std::fmt::Display;
use std::io;
use std::path::Path;

/// Why a model does not open or run: its file, what is wrong with it, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct ModelError(pub String);

impl ModelError {
    pub(crate) fn at(path: &Path, fault: impl Display) -> Self {
        Self(format!("{}: {fault}", path.display()))
    }

    /// `cause` names the file, as errors of `fs_err` do.
    pub(crate) fn unreadable(cause: &io::Error) -> Self {
        Self(format!("{cause}; put the file there or correct the description"))
    }
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
    /// The vector of such a text is a mixture, which finds one of them at best.
    #[error("the text names several things ({}); ask for each alone (robots with objects answer relations between them)", .0.join(", "))]
    SeveralThings(Vec<String>),
    #[error(
        "the text compares things or places ({0:?}), which robots with objects answer; ask here for the thing alone"
    )]
    Comparison(String),
    #[error("crop {index} has no pixels to encode; drop empty masks first")]
    EmptyCrop { index: usize },
    #[error(transparent)]
    Session(#[from] ModelError),
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
