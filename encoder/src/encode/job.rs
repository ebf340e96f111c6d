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
const FINGERPRINT_KEY: &[u8] = b"fingerprint";
/// There once the views that are done were published, with others left to do.
const PUBLISHED_KEY: &[u8] = b"published";
const VIEW_PREFIX: &str = "view/";

/// What the record that counts a view as done says of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ViewRecord {
    /// Width at which its weights were rasterised.
    pub(super) raster_width_px: u32,
    /// Seconds of its stages before this record.
    pub(super) secs: f32,
}

/// An encode under way in a store.
pub(super) struct Job<'a> {
    store: &'a Store,
    records: sled::Tree,
    folder: PathBuf,
}

impl<'a> Job<'a> {
    /// Takes up the unfinished encode with this fingerprint, or begins one.
    ///
    /// # Errors
    /// [`EncodeError::OtherJob`] if another one is unfinished and `restart` is not set.
    pub(super) fn open(store: &'a Store, fingerprint: Hash32, restart: bool) -> Result<Self, EncodeError> {
        let folder = store.job_dir()?;
        let records = store.db().open_tree(TREE).map_err(|source| records_error(store, source))?;
        let job = Self { store, records, folder };
        let found = job.records.get(FINGERPRINT_KEY).map_err(|source| records_error(store, source))?;
        let same = found.as_deref() == Some(&fingerprint.0);
        let published =
            job.records.contains_key(PUBLISHED_KEY).map_err(|source| records_error(store, source))?;
        // What is published is not lost with its contributions.
        if found.is_some() && !same && !restart && !published {
            return Err(EncodeError::OtherJob {
                path: store.dir().to_owned(),
                n_done: job.done_views()?.len(),
            });
        }
        if !same {
            job.clear()?;
            job.records
                .insert(FINGERPRINT_KEY, &fingerprint.0)
                .map_err(|source| records_error(store, source))?;
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
                // Only for the report; an older program's says nothing.
                Ok((name, serde_json::from_slice(&value).unwrap_or_default()))
            })
            .collect()
    }

    /// Returns where a view's contributions lie.
    pub(super) fn contributions_path(&self, view: &str) -> PathBuf {
        // Names hold separators and may be long; their hash does not.
        self.folder.join("views").join(format!("{}.contributions", Hash32::of(view.as_bytes())))
    }

    /// Returns where the outlines of a view's masks lie.
    pub(super) fn outlines_path(&self, view: &str) -> PathBuf {
        self.contributions_path(view).with_extension("outlines")
    }

    /// Keeps a view's contributions and its masks' outlines: the files first, then the record that counts it as done.
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
        self.records.insert(key, record).map_err(|source| records_error(self.store, source))?;
        self.flush()
    }

    /// Keeps the contributions of views that were published, for an encode that goes on with others.
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
