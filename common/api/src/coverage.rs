//! What an answer could not know.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How much of the region asked for is on board. What is missing there is unknown, not absent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Coverage {
    /// Whether the whole region asked for was fetched; absent without `radius` and `box`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub area_fetched: Option<bool>,
    /// Cells in the region asked for whose shards could not be fetched.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub bad_cells: Vec<BadCellAnswer>,
}

/// A cell whose shard could not be fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct BadCellAnswer {
    /// The cell.
    pub cell_id: u32,
    /// The earlier generation that answers for it; absent: nothing of it is on board.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub generation: Option<u64>,
}

impl Coverage {
    /// Returns in words what is not on board, and what to do; `None` if nothing is known to be missing.
    pub fn missing(&self) -> Option<String> {
        let place = if self.area_fetched.is_some() { " in the region" } else { "" };
        match self.bad_cells.iter().filter(|bad| bad.generation.is_none()).count() {
            0 if self.area_fetched == Some(false) => {
                Some("part of the region was not fetched; fetch it for a complete answer".to_owned())
            }
            0 => None,
            1 => Some(format!("1 cell{place} could not be fetched; fetch again for a complete answer")),
            n => Some(format!("{n} cells{place} could not be fetched; fetch again for a complete answer")),
        }
    }
}
