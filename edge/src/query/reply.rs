//! The answers to a request.

use std::sync::Arc;

use slag_common::manifest::Manifest;

use super::answers::{Answers, Found, GaussianAnswer};
use super::request::QueryRequest;
use crate::score::Hit;
use crate::store::Snapshot;

/// The answers to a request and their generation.
pub struct Reply {
    pub(super) snapshot: Arc<Snapshot>,
    pub(super) request: QueryRequest,
    /// By question.
    pub answers: Vec<Answers>,
}

impl Reply {
    pub fn manifest(&self) -> &Manifest {
        &self.snapshot.manifest
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
