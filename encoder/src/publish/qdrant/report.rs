//! Progress and result of a push.

use serde::Serialize;

use super::index::SettingChange;
use super::snapshot::Snapshot;

/// Progress of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PushProgress {
    /// Points of this generation in the database.
    pub n_points: u64,
    /// Points of this generation at the end.
    pub n_points_expected: u64,
}

/// Result of a push.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct PushReport {
    /// Points of this generation, all in the database.
    pub n_points: u64,
    /// Points sent by this run; earlier runs sent the others.
    pub n_sent: u64,
    /// Gaussians without an embedding, left out.
    pub n_without_evidence: u64,
    /// Repeated attempts.
    pub n_retries: u64,
    /// Collections of this generation.
    pub n_collections: usize,
    /// How many of them this run created.
    pub n_created_collections: usize,
    /// Settings of existing collections that this run changed.
    pub changed_settings: Vec<SettingChange>,
    /// Collections of cells that this generation no longer has, deleted.
    pub deleted_collections: Vec<String>,
    /// Collections named like those of cells that this generation does not have, left alone: they hold points of
    /// other scenes, or none at all and no push from this store is known.
    pub left_collections: Vec<String>,
    /// Snapshots of the collections, where asked for.
    pub snapshots: Vec<Snapshot>,
}
