//! Cells with shards that could not be fetched or opened: each costs that cell only.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};

/// Why a cell's shard is not on board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CellFault {
    /// The store does not have it.
    Missing,
    /// The store's bytes have another hash or length than the manifest lists.
    Damaged,
    /// It has its hash, but is not the shard that the manifest describes.
    Invalid,
    /// Its file on board is missing, damaged or cannot be read.
    Unreadable,
}

/// A cell whose shard does not answer, although it is within the radius.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BadCell {
    /// The cell.
    pub cell_id: u32,
    /// The fault of its shard.
    pub fault: CellFault,
    /// Its shard of an earlier generation, which answers in its place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub old: Option<OldShard>,
}

impl fmt::Display for BadCell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cell_id, fault, old } = self;
        let fault = match fault {
            CellFault::Missing => "missing",
            CellFault::Damaged => "damaged",
            CellFault::Invalid => "invalid",
            CellFault::Unreadable => "unreadable on board",
        };
        write!(f, "{cell_id} ({fault}")?;
        match old {
            Some(old) => write!(f, ", generation {} answers)", old.generation),
            None => f.write_str(")"),
        }
    }
}

/// A shard of an earlier generation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OldShard {
    /// The generation.
    pub generation: u64,
    /// BLAKE3 of its manifest, which is kept on board.
    pub manifest_hash: Hash32,
    /// BLAKE3 of the shard.
    pub hash: Hash32,
    /// Length of the shard.
    pub len_bytes: u64,
}

pub fn cell_of(manifest: &Manifest, cell_id: u32) -> Option<&CellRecord> {
    let position = manifest.cells.partition_point(|cell| cell.cell_id < cell_id);
    manifest.cells.get(position).filter(|cell| cell.cell_id == cell_id)
}

/// Returns whether an earlier generation's shard of a cell may be used with a new generation: both describe the same
/// Gaussians, in the same frame and embedding space.
pub fn can_stand_in(old: &Manifest, new: &Manifest, cell_id: u32) -> bool {
    let is_same_scene = old.scene == new.scene
        && (old.encoder.id, old.encoder.dim) == (new.encoder.id, new.encoder.dim)
        && (old.metric, old.geo_reference) == (new.metric, new.geo_reference);
    let same_cell = |(old, new): (&CellRecord, &CellRecord)| {
        old.bounds == new.bounds && old.n_gaussians == new.n_gaussians
    };
    is_same_scene && cell_of(old, cell_id).zip(cell_of(new, cell_id)).is_some_and(same_cell)
}
