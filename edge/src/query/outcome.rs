//! The answers to a question, of either sort.

use std::collections::BTreeMap;

use super::answers::{Answers, ClusterAnswer};
use super::relations::{Found, Miss, Witness};

/// The answers to one question.
pub enum Outcome {
    /// To a text or a vector.
    Plain(Answers),
    Related(RelatedAnswers),
}

pub struct RelatedAnswers {
    /// What was asked in place of words that the model does not know.
    pub asked_as: BTreeMap<String, String>,
    /// What was found for each thing of the phrase.
    pub parts: Vec<Found>,
    /// The part that failed, if nothing was found.
    pub miss: Option<Miss>,
    /// The answers, best first, each with its degree and what it is related to.
    pub answers: Vec<(ClusterAnswer, f64, Vec<Witness>)>,
}

impl Outcome {
    /// Returns what was asked in place of words that the model does not know.
    pub fn asked_as(&self) -> &BTreeMap<String, String> {
        match self {
            Self::Plain(answers) => &answers.asked_as,
            Self::Related(related) => &related.asked_as,
        }
    }

    pub(super) fn set_asked_as(&mut self, asked_as: BTreeMap<String, String>) {
        match self {
            Self::Plain(answers) => answers.asked_as = asked_as,
            Self::Related(related) => related.asked_as = asked_as,
        }
    }

    /// Returns the number of answers.
    pub fn len(&self) -> usize {
        match self {
            Self::Plain(answers) => answers.answers.len(),
            Self::Related(related) => related.answers.len(),
        }
    }

    /// Returns whether there is no answer.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
