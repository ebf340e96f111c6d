//! What an answer could not know.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How much of the region asked for is on board. What is missing there is unknown, not absent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Coverage {
    /// Whether all cells in the region asked for, or of the whole scene, are on board.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub area_fetched: Option<bool>,
    /// Number of these cells that were not fetched.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub n_cells_not_fetched: u64,
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
        let said = |n: u64, what: &str| {
            let cells = if n == 1 { "cell" } else { "cells" };
            (n > 0).then(|| format!("{n} {cells} {what} for a complete answer"))
        };
        let n_bad = self.bad_cells.iter().filter(|bad| bad.generation.is_none()).count() as u64;
        said(n_bad, "could not be fetched; fetch again")
            .or_else(|| said(self.n_cells_not_fetched, "not fetched; fetch a larger radius"))
    }
}

#[allow(clippy::trivially_copy_pass_by_ref)] // As serde asks for it.
fn is_zero(n: &u64) -> bool {
    *n == 0
}
