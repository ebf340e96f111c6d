//! Progress records of pushes, in the store.

use serde::{Deserialize, Serialize};
use slag_common::Hash32;

use super::error::PushError;
use super::snapshot::Snapshot;

/// Tree of the progress records.
const PUSH_TREE: &str = "push";

/// Progress of the push of one generation to one collection: finished cells, and points of the next one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) manifest: Option<Hash32>,
    pub(super) n_cells: usize,
    pub(super) n_points_in_cell: usize,
    pub(super) n_points: u64,
    pub(super) n_without_evidence: u64,
    /// Of the complete collection.
    #[serde(default)]
    pub(super) snapshot: Option<Snapshot>,
}

/// The records of the collections of one database.
pub(super) struct Records {
    tree: sled::Tree,
    url: String,
}

impl Records {
    /// `url`: address of the database.
    pub(super) fn open(db: &sled::Db, url: &str) -> Result<Self, PushError> {
        Ok(Self { tree: db.open_tree(PUSH_TREE)?, url: url.trim_end_matches('/').to_owned() })
    }

    fn key(&self, collection: &str) -> String {
        format!("{}\n{collection}", self.url)
    }

    /// Returns the record of a collection, if there is one.
    pub(super) fn read(&self, collection: &str) -> Result<Option<Record>, PushError> {
        let stored = self.tree.get(self.key(collection))?;
        // An unreadable record (of another version) counts as none: the push starts over.
        Ok(stored.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }

    /// Writes a record, to the disk.
    pub(super) async fn write(&self, collection: &str, record: &Record) -> Result<(), PushError> {
        let json = serde_json::to_vec(record).expect("a record is JSON");
        self.tree.insert(self.key(collection), json)?;
        self.tree.flush_async().await?;
        Ok(())
    }

    /// Removes a record, from the disk too.
    pub(super) async fn remove(&self, collection: &str) -> Result<(), PushError> {
        self.tree.remove(self.key(collection))?;
        self.tree.flush_async().await?;
        Ok(())
    }
}
