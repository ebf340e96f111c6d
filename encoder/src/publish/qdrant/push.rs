//! The push: collection by collection, cell by cell, batch by batch, recorded after each.

use std::sync::Arc;

use qdrant_client::qdrant::{CollectionInfo, PointStruct};
use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};

use super::collection::Collection;
use super::database::Database;
use super::error::PushError;
use super::options::PushOptions;
use super::points::{CellPayload, points};
use super::record::{Record, Records};
use super::report::{PushProgress, PushReport};
use super::source::{CellVectors, VectorSource};
use crate::store::StoreReader;

/// Pushes the current generation of a store, continuing where an earlier push of it was interrupted.
///
/// `records`: the store's record database ([`crate::store::Store::db`]). `progress` is called after
/// every batch. `cancel`: completes to stop between or within batches.
///
/// # Errors
/// [`PushError`]. All collections are checked before anything is written.
pub async fn push(
    reader: &StoreReader,
    vectors: Arc<dyn VectorSource>,
    records: &sled::Db,
    options: &PushOptions,
    progress: impl FnMut(PushProgress) + Send,
    cancel: impl Future<Output = ()> + Send,
) -> Result<PushReport, PushError> {
    let database = Database::new(options)?;
    let push = Push {
        database: &database,
        manifest: reader.manifest(),
        manifest_hash: reader.current().hash,
        vectors,
        records: Records::open(records, &options.url)?,
        options,
        report: PushReport::default(),
    };
    tokio::select! {
        biased;
        () = cancel => Err(PushError::Cancelled),
        ended = push.run(progress) => ended,
    }
}

struct Push<'a> {
    database: &'a Database<'a>,
    manifest: &'a Manifest,
    manifest_hash: Hash32,
    vectors: Arc<dyn VectorSource>,
    records: Records,
    options: &'a PushOptions,
    report: PushReport,
}

/// A collection, and the cells that it is to hold.
struct Target<'a> {
    collection: Collection<'a>,
    cells: &'a [CellRecord],
    /// The collection as it was found.
    existing: Option<CollectionInfo>,
}

impl<'a> Push<'a> {
    async fn run(mut self, mut progress: impl FnMut(PushProgress) + Send) -> Result<PushReport, PushError> {
        let mut targets = Vec::new();
        for (name, cells) in self.options.layout.divide(&self.options.collection, self.manifest) {
            let collection = self.collection(name);
            let existing = collection.existing().await?;
            targets.push(Target { collection, cells, existing });
        }
        self.report.n_collections = targets.len();
        for target in &targets {
            self.push_target(target, &mut progress).await?;
        }
        self.remove_obsolete(&targets).await?;
        if self.options.snapshots {
            for target in &targets {
                self.snapshot(&target.collection).await?;
            }
        }
        self.report.n_retries = self.database.n_retries();
        Ok(self.report)
    }

    fn collection(&self, name: String) -> Collection<'a> {
        Collection { database: self.database, name, manifest: self.manifest }
    }

    /// Makes a collection ready and sends the points that it lacks.
    async fn push_target(
        &mut self,
        target: &Target<'a>,
        progress: &mut (impl FnMut(PushProgress) + Send),
    ) -> Result<(), PushError> {
        let (collection, name) = (&target.collection, &target.collection.name);
        let mut record = self.prepare(target).await?;
        let n_points_expected = self.manifest.n_gaussians.saturating_sub(self.manifest.n_without_evidence);
        let n_points_before = self.report.n_points;
        for cell in target.cells.iter().skip(record.n_cells) {
            let (source, cell) = (Arc::clone(&self.vectors), cell.clone());
            let cell_id = cell.cell_id;
            let vectors = Arc::new(tokio::task::spawn_blocking(move || source.load(&cell)).await??);
            vectors.check(cell_id, self.manifest.encoder.dim)?;
            while record.n_points_in_cell < vectors.input_indices.len() {
                let batch = self.batch(&vectors, record.n_points_in_cell, cell_id).await?;
                let n_points = batch.len();
                collection.upsert(batch).await?;
                record.n_points_in_cell += n_points;
                record.n_points += n_points as u64;
                self.report.n_sent += n_points as u64;
                self.records.write(name, &record).await?;
                progress(PushProgress { n_points: n_points_before + record.n_points, n_points_expected });
            }
            record.n_cells += 1;
            record.n_points_in_cell = 0;
            record.n_without_evidence += vectors.n_without_evidence;
            self.records.write(name, &record).await?;
        }
        self.report.n_points += record.n_points;
        self.report.n_without_evidence += record.n_without_evidence;
        collection.remove_other_generations(self.generation()).await?;
        self.check_count(collection, record.n_points).await
    }

    /// Creates the collection if there is none, gives it the settings asked for and its payload indexes, and
    /// returns the progress of earlier pushes.
    async fn prepare(&mut self, target: &Target<'a>) -> Result<Record, PushError> {
        let (collection, name) = (&target.collection, &target.collection.name);
        let info = match &target.existing {
            Some(info) => info.clone(),
            None => {
                // First, so that a push cut off here does not take the new collection for the old one.
                self.records.remove(name).await?;
                collection.create(&self.options.index).await?;
                self.report.n_created_collections += 1;
                collection.describe().await?
            }
        };
        let mut record = self.records.read(name)?.unwrap_or_default();
        if record.manifest != Some(self.manifest_hash) {
            record = Record { manifest: Some(self.manifest_hash), ..Record::default() };
        }
        if let Some(update) = self.options.index.update(name, &info.config.unwrap_or_default()) {
            // The snapshot has the former settings.
            record.snapshot = None;
            self.records.write(name, &record).await?;
            collection.update(update.request).await?;
            self.report.changed_settings.extend(update.changes);
        }
        collection.ensure_indexes(&info.payload_schema).await?;
        Ok(record)
    }

    /// Deletes the collections of cells that the scene no longer has. Those with points of other scenes stay,
    /// and empty ones that no push from this store made.
    async fn remove_obsolete(&mut self, targets: &[Target<'a>]) -> Result<(), PushError> {
        let layout = self.options.layout;
        let mut names = match layout {
            super::Layout::One => return Ok(()),
            super::Layout::Cells => self.database.collection_names().await?,
        };
        names.sort_unstable();
        for name in names {
            let wanted = targets.iter().any(|target| target.collection.name == name);
            if wanted || !layout.names(&self.options.collection, &name) {
                continue;
            }
            let collection = self.collection(name.clone());
            let ours = collection.count_others().await? == 0
                && (self.records.read(&name)?.is_some() || collection.count(None).await? > 0);
            if ours {
                collection.delete().await?;
                self.records.remove(&name).await?;
                self.report.deleted_collections.push(name);
            } else {
                self.report.left_collections.push(name);
            }
        }
        Ok(())
    }

    /// Reports the snapshot of a complete collection: the one of an earlier run if the collection is unchanged
    /// and the database still has it, or else a new one.
    async fn snapshot(&mut self, collection: &Collection<'a>) -> Result<(), PushError> {
        let mut record = self.records.read(&collection.name)?.unwrap_or_default();
        let mut kept = record.snapshot.take();
        if let Some(snapshot) = &kept
            && !collection.has_snapshot(snapshot).await?
        {
            kept = None;
        }
        let snapshot = match kept {
            Some(snapshot) => snapshot,
            None => {
                let snapshot = collection.create_snapshot().await?;
                record.snapshot = Some(snapshot.clone());
                self.records.write(&collection.name, &record).await?;
                snapshot
            }
        };
        self.report.snapshots.push(snapshot);
        Ok(())
    }

    /// Returns the generation as the database's integer type.
    fn generation(&self) -> i64 {
        i64::try_from(self.manifest.generation).unwrap_or(i64::MAX)
    }

    /// Builds the batch that begins at a point of a cell, off the asynchronous threads.
    async fn batch(
        &self,
        vectors: &Arc<CellVectors>,
        start: usize,
        cell_id: u32,
    ) -> Result<Vec<PointStruct>, PushError> {
        let n_points = self.options.n_points_per_batch.get();
        let end = vectors.input_indices.len().min(start.saturating_add(n_points));
        let cell = CellPayload {
            scene: self.manifest.scene.clone(),
            generation: self.generation(),
            cell_id,
            geo_reference: self.manifest.geo_reference,
        };
        let (vectors, dim) = (Arc::clone(vectors), self.manifest.encoder.dim as usize);
        Ok(tokio::task::spawn_blocking(move || points(&vectors, start..end, dim, &cell)).await?)
    }

    /// Compares the number of points in the collection with the number pushed; if they differ, the next push
    /// starts this collection over.
    async fn check_count(&self, collection: &Collection<'a>, expected: u64) -> Result<(), PushError> {
        let found = collection.count(None).await?;
        if found == expected {
            return Ok(());
        }
        self.records.remove(&collection.name).await?;
        Err(PushError::Count { collection: collection.name.clone(), expected, found })
    }
}
