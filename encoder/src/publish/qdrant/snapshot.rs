//! Snapshots of collections.

use serde::{Deserialize, Serialize};

use super::collection::Collection;
use super::error::PushError;

/// A snapshot of a collection, on the database's disk.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The collection.
    pub collection: String,
    /// File name of the snapshot.
    pub name: String,
    /// Size of the file.
    pub size_bytes: u64,
    /// SHA-256 of the file, hexadecimal; servers before 1.8 state none.
    pub sha256: Option<String>,
}

impl Collection<'_> {
    /// Asks for a snapshot and waits for it.
    pub(super) async fn create_snapshot(&self) -> Result<Snapshot, PushError> {
        let create = || self.database.patient_client.create_snapshot(self.name.as_str());
        let created = self.database.attempt("create a snapshot", create).await?;
        let described = created.snapshot_description;
        let described = described.ok_or_else(|| PushError::NoSnapshot { collection: self.name.clone() })?;
        Ok(Snapshot {
            collection: self.name.clone(),
            name: described.name,
            size_bytes: u64::try_from(described.size).unwrap_or(0),
            sha256: described.checksum,
        })
    }

    /// Returns whether the database still has a snapshot.
    pub(super) async fn has_snapshot(&self, snapshot: &Snapshot) -> Result<bool, PushError> {
        let list = || self.database.client.list_snapshots(self.name.as_str());
        let listed = self.database.attempt("list snapshots", list).await?;
        Ok(listed.snapshot_descriptions.iter().any(|listed| {
            listed.name == snapshot.name
                && u64::try_from(listed.size) == Ok(snapshot.size_bytes)
                && listed.checksum == snapshot.sha256
        }))
    }
}
