//! What a fetch did.

use glam::DVec3;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::shard::Profile;

/// Some shards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// Shards.
    pub n_shards: usize,
    /// Their length.
    pub bytes: u64,
}

impl Tally {
    pub(super) fn of(lengths: impl Iterator<Item = u64>) -> Self {
        lengths.fold(Self::default(), |sum, len| Self {
            n_shards: sum.n_shards + 1,
            bytes: sum.bytes.saturating_add(len),
        })
    }
}

/// What a fetch did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FetchReport {
    /// The scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// BLAKE3 of the signed manifest.
    pub manifest_hash: Hash32,
    /// The public key that signed it.
    pub key: Hash32,
    /// The key that it names as its successor; accepted from now on, too.
    pub next_key: Option<Hash32>,
    /// The key whose place this one took: no longer accepted from now on.
    pub replaced_key: Option<Hash32>,
    /// Whether the key was accepted just because it was the first.
    pub is_first_contact: bool,
    /// The encoder whose text model answers queries.
    pub encoder_id: Hash32,
    /// Its name.
    pub encoder_name: String,
    /// The profile of the shards.
    pub profile: Profile,
    /// The centre, world frame.
    pub centre_in_world: DVec3,
    /// The radius, world units.
    pub radius: f64,
    /// Cells within it.
    pub n_cells: usize,
    /// Shards that came in.
    pub downloaded: Tally,
    /// Shards that were on board and are needed.
    pub kept: Tally,
    /// Shards that are not needed but fit the budget.
    pub spare: Tally,
    /// Shards that were removed.
    pub freed: Tally,
    /// Bytes of the downloaded shards that an interrupted fetch had left.
    pub resumed_bytes: u64,
    /// Attempts beyond the first.
    pub retries: u64,
    /// Duration.
    pub seconds: f64,
}
