//! Which collections a scene is pushed to.

use slag_common::manifest::{CellRecord, Manifest};

/// Which collections a scene is pushed to.
///
/// Shard keys, which divide one collection, need a distributed Qdrant; a collection a cell needs nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Layout {
    /// One collection, `NAME`.
    #[default]
    One,
    /// One collection a cell, `NAME-cell-ID`: each can be snapshotted, dropped and restored alone.
    Cells,
}

impl Layout {
    /// Returns the collections for a scene, with the cells of each.
    pub(super) fn divide<'a>(self, name: &str, manifest: &'a Manifest) -> Vec<(String, &'a [CellRecord])> {
        let cells = manifest.cells.as_slice();
        match self {
            Self::One => vec![(name.to_owned(), cells)],
            Self::Cells => {
                cells.chunks(1).map(|cell| (cell_collection(name, cell[0].cell_id), cell)).collect()
            }
        }
    }

    /// Returns whether a collection is named as that of a cell, of this scene or an earlier generation of it.
    pub(super) fn names(self, name: &str, collection: &str) -> bool {
        let id = collection.strip_prefix(name).and_then(|rest| rest.strip_prefix("-cell-"));
        let id = id.and_then(|id| id.parse::<u32>().ok());
        // An id has one spelling: `+7` and `007` are not ours.
        self == Self::Cells && id.is_some_and(|id| cell_collection(name, id) == collection)
    }
}

fn cell_collection(name: &str, cell_id: u32) -> String {
    format!("{name}-cell-{cell_id}")
}
