//! The state of an unfinished encode: which views are done, and their files of contributions.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use slag_common::Hash32;

use super::error::EncodeError;
use crate::lift::ViewContributions;
use crate::lift::photos::{self, MaskOutline};
use crate::store::Store;

const TREE: &str = "job";
const IDENTITY_KEY: &[u8] = b"identity";
/// Present while every finished view of the job is published.
const PUBLISHED_KEY: &[u8] = b"published";
const VIEW_PREFIX: &str = "view/";

/// The record of a finished view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ViewRecord {
    /// Width at which its weights were rasterised.
    pub(super) raster_width_px: u32,
    /// Seconds in its stages before this record.
    pub(super) secs: f32,
}

/// The unfinished encode of a store.
pub(super) struct Job<'a> {
    store: &'a Store,
    records: sled::Tree,
    folder: PathBuf,
}

impl<'a> Job<'a> {
    /// Takes up the unfinished encode of this identity, or begins one.
    ///
    /// # Errors
    /// [`EncodeError::OtherJob`] if one of another identity is unfinished and `restart` is not set.
    pub(super) fn open(store: &'a Store, identity: Hash32, restart: bool) -> Result<Self, EncodeError> {
        let folder = store.job_dir()?;
        let records = store.db().open_tree(TREE).map_err(|source| records_error(store, source))?;
        let job = Self { store, records, folder };
        let found = job.records.get(IDENTITY_KEY).map_err(|source| records_error(store, source))?;
        let same = found.as_deref() == Some(&identity.0);
        let published =
            job.records.contains_key(PUBLISHED_KEY).map_err(|source| records_error(store, source))?;
        // A published job loses only its contributions, which the published generation does not need.
        if found.is_some() && !same && !restart && !published {
            return Err(EncodeError::OtherJob {
                path: store.dir().to_owned(),
                n_done: job.done_views()?.len(),
            });
        }
        if !same {
            job.clear()?;
            job.records.insert(IDENTITY_KEY, &identity.0).map_err(|source| records_error(store, source))?;
            job.flush()?;
        }
        fs_err::create_dir_all(job.folder.join("views"))?;
        Ok(job)
    }

    /// Returns the views whose contributions are on disk.
    pub(super) fn done_views(&self) -> Result<BTreeMap<String, ViewRecord>, EncodeError> {
        let records = self.records.scan_prefix(VIEW_PREFIX);
        records
            .map(|record| {
                let (key, value) = record.map_err(|source| records_error(self.store, source))?;
                let name = String::from_utf8_lossy(&key[VIEW_PREFIX.len()..]).into_owned();
                // The record feeds the report alone.
                Ok((name, serde_json::from_slice(&value).unwrap_or_default()))
            })
            .collect()
    }

    /// Returns the file of a view's contributions.
    pub(super) fn contributions_path(&self, view: &str) -> PathBuf {
        // Names hold separators and may be long; their hash does not.
        self.folder.join("views").join(format!("{}.contributions", Hash32::of(view.as_bytes())))
    }

    /// Returns the file of the outlines of a view's masks.
    pub(super) fn outlines_path(&self, view: &str) -> PathBuf {
        self.contributions_path(view).with_extension("outlines")
    }

    /// Keeps a view's contributions and its masks' outlines: the files first, then the record that marks it as done.
    pub(super) fn keep(
        &self,
        view: &str,
        contributions: &ViewContributions,
        outlines: &[MaskOutline],
        record: ViewRecord,
    ) -> Result<(), EncodeError> {
        photos::write_outlines(&self.outlines_path(view), outlines)?;
        contributions.write(&self.contributions_path(view))?;
        let key = format!("{VIEW_PREFIX}{view}");
        let record = serde_json::to_vec(&record).map_err(std::io::Error::from)?;
        // In one step: with a view that was not published, the job may no longer be dropped silently.
        let mut batch = sled::Batch::default();
        batch.insert(key.as_bytes(), record);
        batch.remove(PUBLISHED_KEY);
        self.records.apply_batch(batch).map_err(|source| records_error(self.store, source))?;
        self.flush()
    }

    /// Keeps the contributions of published views, for an encode that adds other views.
    pub(super) fn keep_published(self) -> Result<(), EncodeError> {
        self.records.insert(PUBLISHED_KEY, &[]).map_err(|source| records_error(self.store, source))?;
        self.flush()
    }

    /// Forgets the job: it was published.
    pub(super) fn finish(self) -> Result<(), EncodeError> {
        self.clear()
    }

    /// Records go first: a file without a record is redone, a record without a file would be an error.
    fn clear(&self) -> Result<(), EncodeError> {
        self.records.clear().map_err(|source| records_error(self.store, source))?;
        self.flush()?;
        if self.folder.exists() {
            fs_err::remove_dir_all(&self.folder)?;
        }
        Ok(())
    }

    fn flush(&self) -> Result<(), EncodeError> {
        self.records.flush().map_err(|source| records_error(self.store, source))?;
        Ok(())
    }
}

fn records_error(store: &Store, source: sled::Error) -> EncodeError {
    EncodeError::Records { path: store.dir().to_owned(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keep(job: &Job<'_>, view: &str) {
        let contributions = ViewContributions {
            dim: 1,
            mask_vectors: Vec::new(),
            masks_of_region: Vec::new(),
            entries_of_cell: Vec::new(),
        };
        job.keep(view, &contributions, &[], ViewRecord::default()).expect("keeps");
    }

    /// A published job may be dropped, but not the views that a later run adds to it before it is published again.
    #[test]
    fn views_added_to_a_published_job_are_not_dropped_silently() {
        let dir = tempfile::tempdir().expect("a folder");
        let store = Store::create_or_open(dir.path()).expect("opens");
        let open = |identity| Job::open(&store, Hash32([identity; 32]), false);
        let job = open(1).expect("begins");
        keep(&job, "a");
        job.keep_published().expect("marks");
        keep(&open(1).expect("goes on"), "b");
        assert!(matches!(open(2), Err(EncodeError::OtherJob { n_done: 2, .. })));
        open(1).expect("goes on").keep_published().expect("marks");
        assert!(open(2).expect("what is published may go").done_views().expect("reads").is_empty());
    }
}
