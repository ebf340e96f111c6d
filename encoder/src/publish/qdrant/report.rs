//! Progress and result of a push.

use serde::Serialize;

/// Progress of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PushProgress {
    /// Points of this generation in the database.
    pub n_points: u64,
    /// Points of this generation at the end.
    pub n_points_expected: u64,
}

/// Result of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PushReport {
    /// Points of this generation, all in the database.
    pub n_points: u64,
    /// Points sent by this run; earlier runs sent the others.
    pub n_sent: u64,
    /// Gaussians without an embedding, left out.
    pub n_without_evidence: u64,
    /// Repeated attempts.
    pub n_retries: u64,
    /// Whether this run created the collection.
    pub created_collection: bool,
}
