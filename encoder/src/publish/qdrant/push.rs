//! The push: cell by cell, batch by batch, recorded after each.

use std::sync::Arc;

use qdrant_client::qdrant::PointStruct;
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use super::collection::Collection;
use super::database::Database;
use super::error::PushError;
use super::options::PushOptions;
use super::points::{CellPayload, points};
use super::report::{PushProgress, PushReport};
use super::source::{CellVectors, VectorSource};
use crate::store::StoreReader;

/// Tree of the progress records.
const PUSH_TREE: &str = "push";

/// Pushes the current generation of a store, continuing where an earlier push of it was interrupted.
///
/// `records`: the store's record database ([`crate::store::Store::db`]). `progress` is called after
/// every batch. `cancel`: completes to stop between or within batches.
///
/// # Errors
/// [`PushError`].
pub async fn push(
    reader: &StoreReader,
    vectors: Arc<dyn VectorSource>,
    records: &sled::Db,
    options: &PushOptions,
    progress: impl FnMut(PushProgress) + Send,
    cancel: impl Future<Output = ()> + Send,
) -> Result<PushReport, PushError> {
    let database = Database::new(options)?;
    let push = Push::new(reader, vectors, records, options, &database)?;
    tokio::select! {
        biased;
        () = cancel => Err(PushError::Cancelled),
        ended = push.run(progress) => ended,
    }
}

/// Progress of the push of one generation: finished cells, and points of the next one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Record {
    manifest: Option<Hash32>,
    n_cells: usize,
    n_points_in_cell: usize,
    n_points: u64,
    n_without_evidence: u64,
}

struct Push<'a> {
    collection: Collection<'a>,
    manifest: &'a Manifest,
    manifest_hash: Hash32,
    vectors: Arc<dyn VectorSource>,
    records: sled::Tree,
    record_key: String,
    options: &'a PushOptions,
}

impl<'a> Push<'a> {
    fn new(
        reader: &'a StoreReader,
        vectors: Arc<dyn VectorSource>,
        records: &sled::Db,
        options: &'a PushOptions,
        database: &'a Database<'a>,
    ) -> Result<Self, PushError> {
        let manifest = reader.manifest();
        Ok(Self {
            collection: Collection { database, name: &options.collection, manifest },
            manifest,
            manifest_hash: reader.current().hash,
            vectors,
            records: records.open_tree(PUSH_TREE)?,
            record_key: format!("{}\n{}", options.url.trim_end_matches('/'), options.collection),
            options,
        })
    }

    async fn run(self, mut progress: impl FnMut(PushProgress) + Send) -> Result<PushReport, PushError> {
        let created_collection = self.collection.ensure().await?;
        let mut record = self.read_record()?;
        if created_collection || record.manifest != Some(self.manifest_hash) {
            record = Record { manifest: Some(self.manifest_hash), ..Record::default() };
        }
        let n_points_expected = self.manifest.n_gaussians.saturating_sub(self.manifest.n_without_evidence);
        let n_before = record.n_points;
        for cell in self.manifest.cells.iter().skip(record.n_cells) {
            let (source, cell) = (Arc::clone(&self.vectors), cell.clone());
            let cell_id = cell.cell_id;
            let vectors = Arc::new(tokio::task::spawn_blocking(move || source.load(&cell)).await??);
            vectors.check(cell_id, self.manifest.encoder.dim)?;
            while record.n_points_in_cell < vectors.input_indices.len() {
                let batch = self.batch(&vectors, record.n_points_in_cell, cell_id).await?;
                let n_points = batch.len();
                self.collection.upsert(batch).await?;
                record.n_points_in_cell += n_points;
                record.n_points += n_points as u64;
                self.write_record(&record).await?;
                progress(PushProgress { n_points: record.n_points, n_points_expected });
            }
            record.n_cells += 1;
            record.n_points_in_cell = 0;
            record.n_without_evidence += vectors.n_without_evidence;
            self.write_record(&record).await?;
        }
        self.collection.remove_other_generations(self.generation()).await?;
        self.check_count(record.n_points).await?;
        Ok(PushReport {
            n_points: record.n_points,
            n_sent: record.n_points - n_before,
            n_without_evidence: record.n_without_evidence,
            n_retries: self.collection.database.n_retries(),
            created_collection,
        })
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
    /// starts over.
    async fn check_count(&self, expected: u64) -> Result<(), PushError> {
        let found = self.collection.count(None).await?;
        if found == expected {
            return Ok(());
        }
        self.records.remove(&self.record_key)?;
        self.records.flush_async().await?;
        Err(PushError::Count { collection: self.options.collection.clone(), expected, found })
    }

    fn read_record(&self) -> Result<Record, PushError> {
        let stored = self.records.get(&self.record_key)?;
        // An unreadable record (of another version) counts as none: the push starts over.
        Ok(stored.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default())
    }

    async fn write_record(&self, record: &Record) -> Result<(), PushError> {
        let json = serde_json::to_vec(record).expect("a record is JSON");
        self.records.insert(&self.record_key, json)?;
        self.records.flush_async().await?;
        Ok(())
    }
}
