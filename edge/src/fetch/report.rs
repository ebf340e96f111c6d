//! Report of a fetch.

use glam::DVec3;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::shard::Profile;

use crate::store::BadCell;

/// Number and length of some shards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    pub n_shards: usize,
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

/// The text model that a scene carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct TextModelTally {
    /// Length of its files.
    pub bytes: u64,
    /// Length of those that were downloaded.
    pub downloaded_bytes: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FetchReport {
    pub scene: String,
    pub generation: u64,
    /// BLAKE3 of the manifest.
    pub manifest_hash: Hash32,
    /// Version of the root by which the manifest is trusted.
    pub root_version: u64,
    /// Whether that root was accepted because it was the first.
    pub is_first_contact: bool,
    /// The encoder whose text model answers queries.
    pub encoder_id: Hash32,
    pub encoder_name: String,
    pub profile: Profile,
    /// Centre, world frame.
    pub centre_in_world: DVec3,
    /// Radius, world units.
    pub radius: f64,
    pub n_cells: usize,
    /// Those whose shard could not be fetched.
    pub bad_cells: Vec<BadCell>,
    pub downloaded: Tally,
    /// Needed shards that were on board already.
    pub kept: Tally,
    /// Shards on board that are not needed but fit the budget.
    pub spare: Tally,
    pub freed: Tally,
    /// The text model, if the scene carries one; not counted among the shards.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text_model: Option<TextModelTally>,
    /// Bytes of the downloaded objects left by an interrupted fetch.
    pub resumed_bytes: u64,
    /// Attempts beyond the first.
    pub retries: u64,
    pub seconds: f64,
}
