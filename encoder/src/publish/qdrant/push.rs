//! The push: collection by collection, cell by cell, batch by batch, recorded after each.

use qdrant_client::qdrant::{CollectionInfo, Filter};
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};

use super::database::{Collection, Database, exact_shard, points};
use super::{Layout, PushError, PushOptions, PushProgress, PushReport};
use crate::store::StoreReader;

/// Pushes a store's current generation, continuing an interrupted push of it. `records`: the store's record database
/// ([`crate::store::Store::db`]). `progress` is called after every batch. `cancel`: completes to stop at any time.
///
/// # Errors
/// [`PushError`]. All collections are checked before anything is written.
pub(crate) async fn push(
    reader: &StoreReader,
    records: &sled::Db,
    options: &PushOptions,
    progress: impl FnMut(PushProgress) + Send,
    cancel: impl Future<Output = ()> + Send,
) -> Result<PushReport, PushError> {
    let database = Database::new(options)?;
    let records = Records { tree: records.open_tree("push")?, url: options.url.trim_end_matches('/') };
    let store = records.store(reader.current().hash).await?;
    let push = Push { database: &database, reader, records, store, options, report: PushReport::default() };
    tokio::select! {
        biased;
        () = cancel => Err(PushError::Cancelled),
        ended = push.run(progress) => ended,
    }
}

/// Progress of the push of one generation to one collection: finished cells, and points of the next one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Record {
    manifest: Option<Hash32>,
    n_cells: usize,
    n_points_in_cell: usize,
    n_points: u64,
    n_without_evidence: u64,
}

struct Records<'a> {
    tree: sled::Tree,
    url: &'a str,
}

impl Records<'_> {
    fn key(&self, collection: &str) -> String {
        format!("{}\n{collection}", self.url)
    }

    /// What points name as their store: its first manifest that was pushed. Scenes of two stores may have one name.
    async fn store(&self, manifest: Hash32) -> Result<String, PushError> {
        let new = manifest.to_string();
        let known = self.tree.compare_and_swap("store", None::<&str>, Some(new.as_str()))?;
        self.tree.flush_async().await?;
        let known = known.err().and_then(|other| other.current);
        Ok(known.map_or(new, |known| String::from_utf8_lossy(&known).into_owned()))
    }

    fn read(&self, collection: &str) -> Result<Option<Record>, PushError> {
        let stored = self.tree.get(self.key(collection))?;
        // An unreadable record (of another version) counts as absent: the push starts over.
        Ok(stored.and_then(|bytes| serde_json::from_slice(&bytes).ok()))
    }

    /// Flushes to disk.
    async fn write(&self, collection: &str, record: &Record) -> Result<(), PushError> {
        let json = serde_json::to_vec(record).expect("a record is JSON");
        self.tree.insert(self.key(collection), json)?;
        self.tree.flush_async().await?;
        Ok(())
    }

    /// Flushes to disk.
    async fn remove(&self, collection: &str) -> Result<(), PushError> {
        self.tree.remove(self.key(collection))?;
        self.tree.flush_async().await?;
        Ok(())
    }
}

impl Layout {
    fn divide<'a>(self, name: &str, manifest: &'a Manifest) -> Vec<(String, &'a [CellRecord])> {
        let cells = manifest.cells.as_slice();
        match self {
            Self::One => vec![(name.to_owned(), cells)],
            Self::Cells => {
                cells.chunks(1).map(|cell| (cell_collection(name, cell[0].cell_id), cell)).collect()
            }
        }
    }
}

fn cell_collection(name: &str, cell_id: u32) -> String {
    format!("{name}-cell-{cell_id}")
}

/// Whether a collection has the name of a cell's, of this scene or an earlier generation.
fn is_of_cell(name: &str, collection: &str) -> bool {
    let id = collection.strip_prefix(name).and_then(|rest| rest.strip_prefix("-cell-"));
    // Ids have one spelling: `+7` and `007` are not ours.
    id.and_then(|id| id.parse().ok()).is_some_and(|id| cell_collection(name, id) == collection)
}

struct Push<'a> {
    database: &'a Database<'a>,
    reader: &'a StoreReader,
    records: Records<'a>,
    store: String,
    options: &'a PushOptions,
    report: PushReport,
}

struct Target<'a> {
    collection: Collection<'a>,
    cells: &'a [CellRecord],
    existing: Option<CollectionInfo>,
}

impl<'a> Push<'a> {
    async fn run(mut self, mut progress: impl FnMut(PushProgress) + Send) -> Result<PushReport, PushError> {
        let mut targets = Vec::new();
        for (name, cells) in self.options.layout.divide(&self.options.collection, self.reader.manifest()) {
            let collection = self.collection(name);
            let existing = collection.existing().await?;
            targets.push(Target { collection, cells, existing });
        }
        self.report.n_collections = targets.len();
        for target in &targets {
            self.push_target(target, &mut progress).await?;
        }
        if self.options.layout == Layout::Cells {
            self.remove_obsolete(&targets).await?;
        }
        if self.options.snapshots {
            for target in &targets {
                let snapshot = target.collection.create_snapshot().await?;
                self.report.snapshots.push(snapshot);
            }
        }
        self.report.n_retries = self.database.n_retries();
        Ok(self.report)
    }

    fn collection(&self, name: String) -> Collection<'a> {
        Collection {
            database: self.database,
            name,
            manifest: self.reader.manifest(),
            store: self.store.clone(),
        }
    }

    async fn push_target(
        &mut self,
        target: &Target<'a>,
        progress: &mut (impl FnMut(PushProgress) + Send),
    ) -> Result<(), PushError> {
        let (collection, name) = (&target.collection, &target.collection.name);
        let manifest = self.reader.manifest();
        let mut record = self.prepare(target).await?;
        let n_points_expected = manifest.n_gaussians.saturating_sub(manifest.n_without_evidence);
        let n_points_before = self.report.n_points;
        for cell in target.cells.iter().skip(record.n_cells) {
            // No request is under way that reading a shard could delay.
            let stored = exact_shard(self.reader, cell)?;
            let shard = stored.view();
            let n_points = shard.n_with_evidence();
            while record.n_points_in_cell < n_points {
                let start = record.n_points_in_cell;
                let end = n_points.min(start.saturating_add(self.options.n_points_per_batch.get()));
                collection.upsert(points(&shard, start..end, manifest, &self.store)).await?;
                record.n_points_in_cell = end;
                record.n_points += (end - start) as u64;
                self.report.n_sent += (end - start) as u64;
                self.records.write(name, &record).await?;
                progress(PushProgress { n_points: n_points_before + record.n_points, n_points_expected });
            }
            record.n_cells += 1;
            record.n_points_in_cell = 0;
            record.n_without_evidence += u64::from(shard.header.n_gaussians) - n_points as u64;
            self.records.write(name, &record).await?;
        }
        self.report.n_points += record.n_points;
        self.report.n_without_evidence += record.n_without_evidence;
        collection.remove_other_generations().await?;
        self.check_count(collection, record.n_points).await
    }

    /// Creates the collection if missing, applies the settings and payload indexes, and returns the progress of earlier
    /// pushes.
    async fn prepare(&mut self, target: &Target<'a>) -> Result<Record, PushError> {
        let (collection, name) = (&target.collection, &target.collection.name);
        let info = match &target.existing {
            Some(info) => {
                if let Some(request) = self.options.index.update(name) {
                    collection.update(request).await?;
                }
                info.clone()
            }
            None => {
                // First, so that a push cut off here does not mistake the new collection for the old one.
                self.records.remove(name).await?;
                collection.create(&self.options.index).await?;
                self.report.n_created_collections += 1;
                collection.describe().await?
            }
        };
        let manifest = Some(self.reader.current().hash);
        let known = self.records.read(name)?.filter(|record| record.manifest == manifest);
        let record = known.unwrap_or_else(|| Record { manifest, ..Record::default() });
        collection.ensure_indexes(&info.payload_schema).await?;
        Ok(record)
    }

    /// Deletes collections of cells that the scene no longer has, except those with other stores' points and those that
    /// no push from this store made.
    async fn remove_obsolete(&mut self, targets: &[Target<'a>]) -> Result<(), PushError> {
        let mut names = self.database.collection_names().await?;
        names.sort_unstable();
        names.retain(|name| is_of_cell(&self.options.collection, name));
        names.retain(|name| targets.iter().all(|target| target.collection.name != *name));
        for name in names {
            let collection = self.collection(name.clone());
            if self.records.read(&name)?.is_some() && collection.count_others().await? == 0 {
                collection.delete().await?;
                self.records.remove(&name).await?;
                self.report.deleted_collections.push(name);
            }
        }
        Ok(())
    }

    /// If the collection has another number of points than were pushed, the next push starts it over.
    async fn check_count(&self, collection: &Collection<'a>, expected: u64) -> Result<(), PushError> {
        let found = collection.count(Filter::default()).await?;
        if found == expected {
            return Ok(());
        }
        self.records.remove(&collection.name).await?;
        Err(PushError::Count { collection: collection.name.clone(), expected, found })
    }
}
