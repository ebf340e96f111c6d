//! The answers to a request.

use std::sync::Arc;

use slag_common::manifest::Manifest;

use super::answers::{Answers, Found, GaussianAnswer};
use super::outcome::Outcome;
use super::request::QueryRequest;
use crate::score::Hit;
use crate::store::Snapshot;

/// The answers to a request, and the generation they refer to.
pub struct Reply {
    pub(super) snapshot: Arc<Snapshot>,
    pub(super) request: QueryRequest,
    /// One for each question, in their order.
    pub outcomes: Vec<Outcome>,
}

impl Reply {
    /// Returns the manifest of the generation that answered.
    pub fn manifest(&self) -> &Manifest {
        &self.snapshot.manifest
    }

    /// Returns the answers to texts and vectors, in their order.
    pub fn answers(&self) -> impl Iterator<Item = &Answers> {
        self.outcomes.iter().filter_map(|outcome| match outcome {
            Outcome::Plain(answers) => Some(answers),
            Outcome::Related(_) => None,
        })
    }

    /// Describes an answer's Gaussians; empty for other kinds.
    pub fn gaussians(&self, answers: &Answers) -> Vec<GaussianAnswer> {
        let Found::Gaussians(hits) = &answers.answers else { return Vec::new() };
        hits.iter().enumerate().map(|(at, hit)| self.gaussian(at, hit)).collect()
    }

    /// Describes one Gaussian. `at`: its index in the list.
    pub(super) fn gaussian(&self, at: usize, hit: &Hit) -> GaussianAnswer {
        GaussianAnswer::new(at, hit, &self.snapshot.shards[hit.shard as usize].view(), self.request.near)
    }
}
