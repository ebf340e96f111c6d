//! Pushes a scene's embeddings into a Qdrant collection: one point a Gaussian.
//!
//! A collection holds one scene. A point's id is the Gaussian's index in the input splat file; its
//! payload has `x`, `y`, `z` (world frame), `cell_id`, `scene`, `generation` and, where the scene is
//! geo-referenced, `location` (`lat`, `lon`).
//!
//! Every batch is acknowledged as applied before the next is sent, and then noted in the store's
//! records: a push that was cut off continues there. Upserts by id can be repeated without harm, so
//! a batch whose acknowledgement was lost arrives once in effect.

mod source;
#[cfg(test)]
mod tests;

use std::fmt;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use qdrant_client::qdrant::vectors_config::Config;
use qdrant_client::qdrant::{
    CollectionInfo, Condition, CountPointsBuilder, CreateCollectionBuilder,
    CreateFieldIndexCollectionBuilder, DeletePointsBuilder, Distance, FieldType, Filter, GeoPoint,
    PointStruct, UpsertPointsBuilder, VectorParams, VectorParamsBuilder,
};
use qdrant_client::{Payload, Qdrant, QdrantError};
use serde::{Deserialize, Serialize};
use slag_common::Hash32;
use slag_common::manifest::Manifest;

use crate::store::StoreReader;
pub use source::{CellVectors, ExactShards, SourceError, VectorSource};

/// Tree of the records of how far pushes came.
const PUSH_TREE: &str = "push";
/// Longest pause between two attempts.
const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);

/// What is pushed where.
#[derive(Clone)]
pub struct PushOptions {
    /// The database's gRPC address, such as `http://127.0.0.1:6334`.
    pub url: String,
    /// The collection; made if it is not there.
    pub collection: String,
    /// Sent with every request.
    pub api_key: Option<String>,
    /// Points in one request.
    pub n_points_per_batch: NonZeroUsize,
    /// Attempts after the first, for errors that may pass.
    pub n_retries: u32,
    /// Pause before the second attempt; doubled each time.
    pub retry_delay: Duration,
    /// Time for one request.
    pub timeout: Duration,
}

impl PushOptions {
    /// Returns options with 256 points a batch (half a megabyte at 512 components) and eight retries
    /// over about a minute.
    pub fn new(url: impl Into<String>, collection: impl Into<String>) -> Self {
        Self {
            url: url.into(),
            collection: collection.into(),
            api_key: None,
            n_points_per_batch: const { NonZeroUsize::new(256).expect("not zero") },
            n_retries: 8,
            retry_delay: Duration::from_millis(250),
            timeout: Duration::from_secs(60),
        }
    }
}

impl fmt::Debug for PushOptions {
    /// Leaves the key out: options end up in logs.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let api_key = self.api_key.as_ref().map(|_| "hidden");
        f.debug_struct("PushOptions")
            .field("url", &self.url)
            .field("collection", &self.collection)
            .field("api_key", &api_key)
            .finish_non_exhaustive()
    }
}

/// How far a push is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PushProgress {
    /// Points that the database has of this generation.
    pub n_points: u64,
    /// Points that it will have.
    pub n_points_expected: u64,
}

/// What a push did.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PushReport {
    /// Points of this generation, all of which the database has.
    pub n_points: u64,
    /// Of these, sent by this run; the others were sent before it.
    pub n_sent: u64,
    /// Gaussians without an embedding, left out.
    pub n_without_evidence: u64,
    /// Attempts that were repeated.
    pub n_retries: u64,
    /// Whether the collection was made.
    pub created_collection: bool,
}

/// Why a push ended.
#[derive(Debug, thiserror::Error)]
pub enum PushError {
    /// The collection holds other vectors.
    #[error(
        "collection {collection:?} has {found}, this scene needs {expected}; choose another collection, or delete this one"
    )]
    Collection {
        /// The collection.
        collection: String,
        /// Its vectors.
        found: String,
        /// The vectors to push.
        expected: String,
    },
    /// The collection holds points that are not this scene's.
    #[error(
        "collection {collection:?} holds {n_points} points that are not of scene {scene:?}, and ids would collide; choose another collection"
    )]
    OtherScene {
        /// The collection.
        collection: String,
        /// The scene to push.
        scene: String,
        /// Points of others.
        n_points: u64,
    },
    /// The database refused, or could not be reached in all attempts.
    #[error(
        "{url}: {action}: {cause}; check address, key and the database's log, then run it again: it continues"
    )]
    Database {
        /// Its address.
        url: String,
        /// What was asked.
        action: &'static str,
        /// What it said.
        cause: Box<QdrantError>,
    },
    /// A cell's vectors cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// Progress cannot be noted.
    #[error("the record of the push cannot be kept: {0}; check the store's free space and permissions")]
    Records(sled::Error),
    /// After all was acknowledged, the database counts other than was pushed.
    #[error(
        "collection {collection:?} has {found} points, {expected} were pushed; was it changed meanwhile? run it again: it starts over"
    )]
    Count {
        /// The collection.
        collection: String,
        /// Points pushed.
        expected: u64,
        /// Points there.
        found: u64,
    },
    /// Stopped on request.
    #[error("the push was stopped; run it again: it continues")]
    Cancelled,
    /// A task of ours failed.
    #[error("{0}; this is a fault of the program, please report it")]
    Task(tokio::task::JoinError),
}

impl From<sled::Error> for PushError {
    fn from(cause: sled::Error) -> Self {
        Self::Records(cause)
    }
}

impl From<tokio::task::JoinError> for PushError {
    fn from(cause: tokio::task::JoinError) -> Self {
        Self::Task(cause)
    }
}

/// Pushes the current generation of a store, continuing where an earlier push of it was cut off.
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
    let push = Push::new(reader, vectors, records, options)?;
    tokio::select! {
        biased;
        () = cancel => Err(PushError::Cancelled),
        ended = push.run(progress) => ended,
    }
}

/// How far the push of one generation came; the cursor is in cells and points of the next cell.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Record {
    manifest: Option<Hash32>,
    n_cells: usize,
    n_points_in_cell: usize,
    n_points: u64,
    n_without_evidence: u64,
}

struct Push<'a> {
    client: Qdrant,
    manifest: &'a Manifest,
    manifest_hash: Hash32,
    vectors: Arc<dyn VectorSource>,
    records: sled::Tree,
    record_key: String,
    options: &'a PushOptions,
    n_retries: AtomicU64,
}

impl<'a> Push<'a> {
    fn new(
        reader: &'a StoreReader,
        vectors: Arc<dyn VectorSource>,
        records: &sled::Db,
        options: &'a PushOptions,
    ) -> Result<Self, PushError> {
        let client = Qdrant::from_url(&options.url)
            .api_key(options.api_key.as_deref())
            .timeout(options.timeout)
            .connect_timeout(options.timeout)
            // The check prints to standard output.
            .skip_compatibility_check()
            .build()
            .map_err(|cause| database_error(options, "set up the client", cause))?;
        Ok(Self {
            client,
            manifest: reader.manifest(),
            manifest_hash: reader.current().hash,
            vectors,
            records: records.open_tree(PUSH_TREE)?,
            record_key: format!("{}\n{}", options.url.trim_end_matches('/'), options.collection),
            options,
            n_retries: AtomicU64::new(0),
        })
    }

    async fn run(self, mut progress: impl FnMut(PushProgress) + Send) -> Result<PushReport, PushError> {
        let created_collection = self.ensure_collection().await?;
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
                self.upsert(batch).await?;
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
        self.remove_earlier_generations().await?;
        self.check_count(record.n_points).await?;
        Ok(PushReport {
            n_points: record.n_points,
            n_sent: record.n_points - n_before,
            n_without_evidence: record.n_without_evidence,
            n_retries: self.n_retries.load(Ordering::Relaxed),
            created_collection,
        })
    }

    /// Makes the collection, or checks that the one there can take this scene; returns whether it made it.
    async fn ensure_collection(&self) -> Result<bool, PushError> {
        let name = &self.options.collection;
        let exists = self.attempt("look for the collection", || self.client.collection_exists(name)).await?;
        if !exists {
            let dim = u64::from(self.manifest.encoder.dim);
            let create = || {
                let vectors = VectorParamsBuilder::new(dim, Distance::Cosine);
                self.client.create_collection(CreateCollectionBuilder::new(name).vectors_config(vectors))
            };
            self.attempt("create the collection", create).await?;
            let place = self.manifest.geo_reference.map(|_| ("location", FieldType::Geo));
            let fields = [("scene", FieldType::Keyword), ("generation", FieldType::Integer)];
            for (field, kind) in fields.into_iter().chain(place) {
                let index = || {
                    let request = CreateFieldIndexCollectionBuilder::new(name, field, kind).wait(true);
                    self.client.create_field_index(request)
                };
                self.attempt("index a payload field", index).await?;
            }
            return Ok(true);
        }
        let info = self.attempt("describe the collection", || self.client.collection_info(name)).await?;
        self.check_vectors(info.result.unwrap_or_default())?;
        let scene = self.manifest.scene.clone();
        let others = Filter::must_not([Condition::matches("scene", scene.clone())]);
        match self.count(Some(others)).await? {
            0 => Ok(false),
            n_points => Err(PushError::OtherScene { collection: name.clone(), scene, n_points }),
        }
    }

    fn check_vectors(&self, info: CollectionInfo) -> Result<(), PushError> {
        let config = info.config.and_then(|c| c.params).and_then(|p| p.vectors_config).and_then(|c| c.config);
        let describe = |size: u64, distance: i32| {
            let distance = Distance::try_from(distance).unwrap_or(Distance::UnknownDistance);
            format!("vectors of {size} components, distance {}", distance.as_str_name())
        };
        let found = match config {
            Some(Config::Params(VectorParams { size, distance, multivector_config: None, .. })) => {
                describe(size, distance)
            }
            Some(Config::Params(_)) => "multivectors".to_owned(),
            Some(Config::ParamsMap(map)) => {
                let mut names: Vec<String> = map.map.into_keys().collect();
                names.sort_unstable();
                format!("named vectors {names:?}")
            }
            None => "no vectors".to_owned(),
        };
        let expected = describe(self.manifest.encoder.dim.into(), Distance::Cosine.into());
        if found == expected {
            return Ok(());
        }
        Err(PushError::Collection { collection: self.options.collection.clone(), found, expected })
    }

    /// Returns the generation as the database's integer type.
    fn generation(&self) -> i64 {
        i64::try_from(self.manifest.generation).unwrap_or(i64::MAX)
    }

    /// Builds the batch that begins at a point of a cell, beside the asynchronous threads.
    async fn batch(
        &self,
        vectors: &Arc<CellVectors>,
        start: usize,
        cell_id: u32,
    ) -> Result<Vec<PointStruct>, PushError> {
        let end =
            vectors.input_indices.len().min(start.saturating_add(self.options.n_points_per_batch.get()));
        let dim = self.manifest.encoder.dim as usize;
        let (vectors, geo_reference) = (Arc::clone(vectors), self.manifest.geo_reference);
        let (scene, generation) = (self.manifest.scene.clone(), self.generation());
        let build = move || {
            let point = |i: usize| {
                let mean = vectors.means_in_world[i];
                let mut payload = Payload::with_capacity(7);
                for (axis, value) in [("x", mean.x), ("y", mean.y), ("z", mean.z)] {
                    payload.insert(axis, value);
                }
                payload.insert("cell_id", i64::from(cell_id));
                payload.insert("scene", scene.clone());
                payload.insert("generation", generation);
                if let Some(place) = geo_reference.map(|reference| reference.geographic_from_world(mean)) {
                    payload
                        .insert("location", GeoPoint { lon: place.longitude_deg, lat: place.latitude_deg });
                }
                let embedding = &vectors.embeddings[i * dim..(i + 1) * dim];
                let vector: Vec<f32> = embedding.iter().map(|v| v.to_f32()).collect();
                PointStruct::new(u64::from(vectors.input_indices[i]), vector, payload)
            };
            (start..end).map(point).collect()
        };
        Ok(tokio::task::spawn_blocking(build).await?)
    }

    async fn upsert(&self, batch: Vec<PointStruct>) -> Result<(), PushError> {
        let request = UpsertPointsBuilder::new(&self.options.collection, batch).wait(true).build();
        self.attempt("upsert points", || self.client.upsert_points(request.clone())).await.map(drop)
    }

    /// Deletes points of Gaussians that this generation no longer has.
    async fn remove_earlier_generations(&self) -> Result<(), PushError> {
        let generation = self.generation();
        let delete = || {
            let others = Filter::must_not([Condition::matches("generation", generation)]);
            let request = DeletePointsBuilder::new(&self.options.collection).points(others).wait(true);
            self.client.delete_points(request)
        };
        self.attempt("delete points of earlier generations", delete).await.map(drop)
    }

    /// Checks what the database has against what was pushed; if they differ, the next push starts over.
    async fn check_count(&self, expected: u64) -> Result<(), PushError> {
        let found = self.count(None).await?;
        if found == expected {
            return Ok(());
        }
        self.records.remove(&self.record_key)?;
        self.records.flush_async().await?;
        Err(PushError::Count { collection: self.options.collection.clone(), expected, found })
    }

    async fn count(&self, filter: Option<Filter>) -> Result<u64, PushError> {
        let count = || {
            let request = CountPointsBuilder::new(&self.options.collection).exact(true);
            self.client.count(match filter.clone() {
                Some(filter) => request.filter(filter),
                None => request,
            })
        };
        let answer = self.attempt("count points", count).await?;
        Ok(answer.result.map_or(0, |result| result.count))
    }

    fn read_record(&self) -> Result<Record, PushError> {
        let stored = self.records.get(&self.record_key)?;
        // One that cannot be read (of another version) is as good as none: the push starts over.
        Ok(stored.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default())
    }

    async fn write_record(&self, record: &Record) -> Result<(), PushError> {
        let json = serde_json::to_vec(record).expect("a record is JSON");
        self.records.insert(&self.record_key, json)?;
        self.records.flush_async().await?;
        Ok(())
    }

    /// Sends a request until it succeeds, fails for good, or attempts run out.
    async fn attempt<T, F>(&self, action: &'static str, request: impl Fn() -> F) -> Result<T, PushError>
    where
        F: Future<Output = Result<T, QdrantError>>,
    {
        let mut delay = self.options.retry_delay;
        for _ in 0..self.options.n_retries {
            match request().await {
                Err(e) if may_pass(&e) => {
                    self.n_retries.fetch_add(1, Ordering::Relaxed);
                    let asked = match &e {
                        QdrantError::ResourceExhaustedError { retry_after_seconds, .. } => {
                            Duration::from_secs(*retry_after_seconds)
                        }
                        _ => Duration::ZERO,
                    };
                    tracing::warn!("{action}: {e}; trying again");
                    tokio::time::sleep(delay.max(asked).min(MAX_RETRY_DELAY)).await;
                    delay = delay.saturating_mul(2);
                }
                answer => return answer.map_err(|cause| database_error(self.options, action, cause)),
            }
        }
        request().await.map_err(|cause| database_error(self.options, action, cause))
    }
}

fn database_error(options: &PushOptions, action: &'static str, cause: QdrantError) -> PushError {
    PushError::Database { url: options.url.clone(), action, cause: Box::new(cause) }
}

/// gRPC status codes, as numbered in its specification (`statuscodes.md`).
mod code {
    pub(super) const CANCELLED: i32 = 1;
    pub(super) const UNKNOWN: i32 = 2;
    pub(super) const DEADLINE_EXCEEDED: i32 = 4;
    pub(super) const RESOURCE_EXHAUSTED: i32 = 8;
    pub(super) const ABORTED: i32 = 10;
    pub(super) const INTERNAL: i32 = 13;
    pub(super) const UNAVAILABLE: i32 = 14;
}

/// Returns whether the same request may succeed later.
fn may_pass(error: &QdrantError) -> bool {
    match error {
        QdrantError::ResourceExhaustedError { .. } | QdrantError::Io(_) => true,
        QdrantError::ResponseError { status } => match status.code() as i32 {
            code::UNAVAILABLE | code::DEADLINE_EXCEEDED | code::RESOURCE_EXHAUSTED | code::ABORTED => true,
            // The client's own time limit, and a connection that broke within a request.
            code::CANCELLED | code::UNKNOWN => true,
            // The client reports a refused connection so.
            code::INTERNAL => status.message().starts_with("Failed to connect"),
            _ => false,
        },
        _ => false,
    }
}
