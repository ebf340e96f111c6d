//! Requests to the database, repeated while their errors may pass.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use qdrant_client::qdrant::{
    CollectionInfo, Condition, CountPointsBuilder, CreateFieldIndexCollectionBuilder, DeletePointsBuilder,
    Distance, FieldType, Filter, GeoPoint, PayloadSchemaInfo, PointStruct, UpdateCollection,
    UpsertPointsBuilder,
};
use qdrant_client::{Payload, Qdrant, QdrantError};
use slag_common::manifest::{CellRecord, Manifest};
use slag_common::retry::{Backoff, Retries};
use slag_common::shard::{Profile, ShardView};

use super::settings::vectors_of;
use super::{IndexSettings, PushError, PushOptions, Snapshot};
use crate::store::{StoreReader, StoredShard};

const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);
/// Time limits of a request, and of one for a snapshot.
const TIMEOUT: Duration = Duration::from_secs(60);
const SNAPSHOT_TIMEOUT: Duration = Duration::from_secs(3600);

pub(super) struct Database<'a> {
    client: Qdrant,
    /// For requests whose time grows with the collection.
    patient_client: Qdrant,
    options: &'a PushOptions,
    n_retries: AtomicU64,
    /// Whether it ever answered.
    is_reached: AtomicBool,
}

impl<'a> Database<'a> {
    pub(super) fn new(options: &'a PushOptions) -> Result<Self, PushError> {
        if !is_address(&options.url) {
            return Err(PushError::Url { url: options.url.clone() });
        }
        let client = |timeout| {
            Qdrant::from_url(&options.url)
                .api_key(options.api_key.as_deref())
                .timeout(timeout)
                .connect_timeout(TIMEOUT)
                // The check would print to stdout.
                .skip_compatibility_check()
                .build()
                .map_err(|cause| database_error(options, "set up the client", &cause))
        };
        Ok(Self {
            client: client(TIMEOUT)?,
            patient_client: client(SNAPSHOT_TIMEOUT)?,
            options,
            n_retries: AtomicU64::new(0),
            is_reached: AtomicBool::new(false),
        })
    }

    pub(super) async fn collection_names(&self) -> Result<Vec<String>, PushError> {
        let listed = self.attempt("list the collections", || self.client.list_collections()).await?;
        Ok(listed.collections.into_iter().map(|collection| collection.name).collect())
    }

    pub(super) fn n_retries(&self) -> u64 {
        self.n_retries.load(Ordering::Relaxed)
    }

    /// Repeats a request until it succeeds, fails permanently, or no attempts are left.
    async fn attempt<T, F>(&self, action: &'static str, request: impl Fn() -> F) -> Result<T, PushError>
    where
        F: Future<Output = Result<T, QdrantError>>,
    {
        let backoff = Backoff { first: self.options.retry_delay, longest: MAX_RETRY_DELAY };
        let mut retries = Retries::new(self.options.n_retries.saturating_add(1), backoff);
        let begun = Instant::now();
        loop {
            let error = match request().await {
                Ok(response) => {
                    self.is_reached.store(true, Ordering::Relaxed);
                    return Ok(response);
                }
                Err(error) => error,
            };
            // One that restarts during a push comes back; one that never answered is at another address.
            let is_lasting = |pause: Duration| {
                is_unreachable(&error)
                    && !self.is_reached.load(Ordering::Relaxed)
                    && begun.elapsed() + pause > self.options.connect_patience
            };
            let pause = retries.failed(false).filter(|pause| may_pass(&error) && !is_lasting(*pause));
            let Some(pause) = pause else {
                return Err(database_error(self.options, action, &error));
            };
            self.n_retries.fetch_add(1, Ordering::Relaxed);
            let asked = match &error {
                QdrantError::ResourceExhaustedError { retry_after_seconds, .. } => {
                    Duration::from_secs(*retry_after_seconds)
                }
                _ => Duration::ZERO,
            };
            tracing::warn!("{action}: {}; trying again", words(&error));
            tokio::time::sleep(pause.max(asked).min(MAX_RETRY_DELAY)).await;
        }
    }
}

fn database_error(options: &PushOptions, action: &'static str, cause: &QdrantError) -> PushError {
    PushError::Database { url: options.url.clone(), action, cause: words(cause) }
}

/// An error's text, without its response's metadata and the transport's internals.
fn words(error: &QdrantError) -> String {
    let (QdrantError::ResponseError { status } | QdrantError::ResourceExhaustedError { status, .. }) = error
    else {
        return error.to_string();
    };
    let (text, insides) =
        status.message().split_once(": tonic::transport::Error").unwrap_or((status.message(), ""));
    let cause = insides.split("message: \"").nth(1).and_then(|rest| rest.split('"').next());
    text.to_owned() + &cause.map_or(String::new(), |cause| format!(": {cause}"))
}

/// Whether a text is a URL with a host and a valid port, if any: with others, a client tries for a minute.
fn is_address(url: &str) -> bool {
    let Some((scheme, rest)) = url.split_once("://") else { return false };
    let host = rest.split(['/', '?', '#']).next().unwrap_or(rest);
    let host = host.rsplit('@').next().unwrap_or(host);
    // An IPv6 address has its colons in brackets.
    let (name, port) = match host.rsplit_once(':') {
        Some((name, port)) if !port.contains(']') => (name, Some(port)),
        _ => (host, None),
    };
    ["http", "https"].iter().any(|known| scheme.eq_ignore_ascii_case(known))
        && !name.is_empty()
        && !url.contains(char::is_whitespace)
        && port.is_none_or(|port| port.parse::<u16>().is_ok())
}

fn is_unreachable(error: &QdrantError) -> bool {
    matches!(error, QdrantError::ResponseError { status } if status.message().starts_with("Failed to connect"))
}

fn may_pass(error: &QdrantError) -> bool {
    match error {
        QdrantError::ResourceExhaustedError { .. } | QdrantError::Io(_) => true,
        // gRPC codes (`statuscodes.md` of its specification).
        QdrantError::ResponseError { status } => match status.code() as i32 {
            // Unavailable, deadline exceeded, resource exhausted, aborted; cancelled and unknown: the client's own time
            // limit, and a connection that broke during a request.
            14 | 4 | 8 | 10 | 1 | 2 => true,
            // Internal: a refused connection.
            13 => is_unreachable(error),
            _ => false,
        },
        _ => false,
    }
}

pub(super) struct Collection<'a> {
    pub(super) database: &'a Database<'a>,
    pub(super) name: String,
    pub(super) manifest: &'a Manifest,
    /// As its points name it.
    pub(super) store: String,
}

impl Collection<'_> {
    /// Returns the existing collection, unchanged; fails if it cannot take this scene.
    pub(super) async fn existing(&self) -> Result<Option<CollectionInfo>, PushError> {
        let exists = || self.database.client.collection_exists(self.name.as_str());
        if !self.database.attempt("look for the collection", exists).await? {
            return Ok(None);
        }
        let info = self.describe().await?;
        self.check_vectors(&info)?;
        match self.count_others().await? {
            0 => Ok(Some(info)),
            n_points => Err(PushError::OtherStore { collection: self.name.clone(), n_points }),
        }
    }

    fn check_vectors(&self, info: &CollectionInfo) -> Result<(), PushError> {
        let params = info.config.clone().and_then(|config| config.params);
        let describe = |size: u64, distance: i32| {
            let distance = Distance::try_from(distance).unwrap_or(Distance::UnknownDistance);
            format!("vectors of {size} components, distance {}", distance.as_str_name())
        };
        let found = vectors_of(params.and_then(|params| params.vectors_config))
            .filter(|vectors| vectors.multivector_config.is_none())
            .map_or("named vectors or several".into(), |vectors| describe(vectors.size, vectors.distance));
        let expected = describe(self.manifest.encoder.dim.into(), Distance::Cosine.into());
        match found == expected {
            true => Ok(()),
            false => Err(PushError::Collection { collection: self.name.clone(), found, expected }),
        }
    }

    pub(super) async fn describe(&self) -> Result<CollectionInfo, PushError> {
        let describe = || self.database.client.collection_info(self.name.as_str());
        let info = self.database.attempt("describe the collection", describe).await?;
        Ok(info.result.unwrap_or_default())
    }

    /// Without payload indexes.
    pub(super) async fn create(&self, index: &IndexSettings) -> Result<(), PushError> {
        let request = index.create(&self.name, self.manifest.encoder.dim.into());
        let create = || self.database.client.create_collection(request.clone());
        self.database.attempt("create the collection", create).await.map(drop)
    }

    pub(super) async fn update(&self, request: UpdateCollection) -> Result<(), PushError> {
        let update = || self.database.client.update_collection(request.clone());
        self.database.attempt("change the collection's settings", update).await.map(drop)
    }

    pub(super) async fn delete(&self) -> Result<(), PushError> {
        let delete = || self.database.client.delete_collection(self.name.as_str());
        self.database.attempt("delete the collection", delete).await.map(drop)
    }

    /// Creates the payload indexes missing in `existing`: an earlier push may have been cut off before them, or not
    /// have been geo-referenced.
    pub(super) async fn ensure_indexes(
        &self,
        existing: &HashMap<String, PayloadSchemaInfo>,
    ) -> Result<(), PushError> {
        let place = self.manifest.geo_reference.map(|_| ("location", FieldType::Geo));
        let names = ["scene", "store"].map(|field| (field, FieldType::Keyword));
        let fields = names.into_iter().chain([("generation", FieldType::Integer)]);
        let missing = fields.chain(place).filter(|(field, _)| !existing.contains_key(*field));
        for (field, kind) in missing {
            let index = || {
                let request = CreateFieldIndexCollectionBuilder::new(&self.name, field, kind).wait(true);
                self.database.client.create_field_index(request)
            };
            self.database.attempt("index a payload field", index).await?;
        }
        Ok(())
    }

    pub(super) async fn upsert(&self, batch: Vec<PointStruct>) -> Result<(), PushError> {
        let request = UpsertPointsBuilder::new(&self.name, batch).wait(true).build();
        let upsert = || self.database.client.upsert_points(request.clone());
        self.database.attempt("upsert points", upsert).await.map(drop)
    }

    /// Deletes points of Gaussians that this generation no longer has.
    pub(super) async fn remove_other_generations(&self) -> Result<(), PushError> {
        let delete = || {
            let others = Filter::must_not([Condition::matches("generation", generation(self.manifest))]);
            self.database.client.delete_points(DeletePointsBuilder::new(&self.name).points(others).wait(true))
        };
        self.database.attempt("delete points of earlier generations", delete).await.map(drop)
    }

    pub(super) async fn count_others(&self) -> Result<u64, PushError> {
        self.count(Filter::must_not([Condition::matches("store", self.store.clone())])).await
    }

    pub(super) async fn count(&self, filter: Filter) -> Result<u64, PushError> {
        let count = || {
            let request = CountPointsBuilder::new(&self.name).exact(true).filter(filter.clone());
            self.database.client.count(request)
        };
        let counted = self.database.attempt("count points", count).await?;
        Ok(counted.result.map_or(0, |result| result.count))
    }

    pub(super) async fn create_snapshot(&self) -> Result<Snapshot, PushError> {
        let create = || self.database.patient_client.create_snapshot(self.name.as_str());
        let created = self.database.attempt("create a snapshot", create).await?;
        let collection = self.name.clone();
        match created.snapshot_description {
            None => Err(PushError::NoSnapshot { collection }),
            Some(made) => Ok(Snapshot {
                collection,
                name: made.name,
                size_bytes: u64::try_from(made.size).unwrap_or(0),
                sha256: made.checksum,
            }),
        }
    }
}

/// A cell's shard with whole embeddings.
pub(super) fn exact_shard(reader: &StoreReader, cell: &CellRecord) -> Result<StoredShard, PushError> {
    let missing = PushError::NoShard { cell_id: cell.cell_id };
    let Some(record) = cell.shards.get(&Profile::Exact) else { return Err(missing) };
    let stored = reader.read_shard(record)?;
    if stored.view().exact.is_some() { Ok(stored) } else { Err(missing) }
}

/// Gaussians with an embedding, in the shard's order.
pub(super) fn points(
    shard: &ShardView<'_>,
    range: std::ops::Range<usize>,
    manifest: &Manifest,
    store: &str,
) -> Vec<PointStruct> {
    let Some(exact) = &shard.exact else { return Vec::new() };
    let dim = shard.header.dim as usize;
    let point = |i: usize| {
        let mean = shard.position_in_world(i);
        let mut payload = Payload::with_capacity(8);
        for (axis, value) in [("x", mean.x), ("y", mean.y), ("z", mean.z)] {
            payload.insert(axis, value);
        }
        payload.insert("cell_id", i64::from(shard.header.cell_id));
        payload.insert("scene", manifest.scene.clone());
        payload.insert("store", store);
        payload.insert("generation", generation(manifest));
        if let Some(place) = manifest.geo_reference.map(|place| place.geographic_from_world(mean)) {
            payload.insert("location", GeoPoint { lon: place.longitude_deg, lat: place.latitude_deg });
        }
        let embedding = &exact.embeddings[i * dim..(i + 1) * dim];
        let vector: Vec<f32> = embedding.iter().map(|v| v.to_f32()).collect();
        PointStruct::new(u64::from(exact.input_indices[i]), vector, payload)
    };
    range.map(point).collect()
}

pub(super) fn generation(manifest: &Manifest) -> i64 {
    i64::try_from(manifest.generation).unwrap_or(i64::MAX)
}
