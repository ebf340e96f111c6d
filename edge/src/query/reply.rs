//! The answers to a request.

use std::collections::BTreeMap;
use std::sync::Arc;

use slag_api::coverage::Coverage;
use slag_common::manifest::Manifest;

use super::answers::{Answers, ClusterAnswer, Found, GaussianAnswer, Reason};
use super::relations::{self, Witness};
use super::request::QueryRequest;
use crate::score::Hit;
use crate::store::Snapshot;

/// The answers to a request and their generation.
pub struct Reply {
    pub(super) snapshot: Arc<Snapshot>,
    pub(super) request: QueryRequest,
    /// By question.
    pub outcomes: Vec<Outcome>,
}

impl Reply {
    pub fn manifest(&self) -> &Manifest {
        &self.snapshot.manifest
    }

    pub fn answers(&self) -> impl Iterator<Item = &Answers> {
        self.outcomes.iter().filter_map(|outcome| match outcome {
            Outcome::Plain(answers) => Some(answers),
            Outcome::Related(_) => None,
        })
    }

    pub fn gaussians(&self, answers: &Answers) -> Vec<GaussianAnswer> {
        let Found::Gaussians(hits) = &answers.answers else { return Vec::new() };
        hits.iter().enumerate().map(|(at, hit)| self.gaussian(at, hit)).collect()
    }

    /// Describes one Gaussian. `at`: its index in the list.
    pub(super) fn gaussian(&self, at: usize, hit: &Hit) -> GaussianAnswer {
        GaussianAnswer::new(at, hit, &self.snapshot.shards[hit.shard as usize].view(), self.request.near)
    }
}

pub enum Outcome {
    /// To a text or a vector.
    Plain(Answers),
    Related(RelatedAnswers),
}

pub struct RelatedAnswers {
    /// Replacements of words that the model does not know.
    pub asked_as: BTreeMap<String, String>,
    pub parts: Vec<relations::Found>,
    pub coverage: Coverage,
    pub miss: Option<Reason>,
    /// Best first, each with its degree and its witnesses.
    pub answers: Vec<(ClusterAnswer, f64, Vec<Witness>)>,
}

impl Outcome {
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

    pub fn coverage(&self) -> &Coverage {
        match self {
            Self::Plain(answers) => &answers.coverage,
            Self::Related(related) => &related.coverage,
        }
    }

    pub fn len(&self) -> usize {
        match self {
            Self::Plain(answers) => answers.answers.len(),
            Self::Related(related) => related.answers.len(),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
