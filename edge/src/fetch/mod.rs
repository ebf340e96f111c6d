//! Fetch: brings the shards around the robot on board, and frees what it left behind.
//!
//! A cut at any moment leaves the old or the new generation, whole: nothing that `current` names is
//! touched before the new `current` is durable, and nothing counts that was not verified. In order:
//!
//! 0. lock; what a killed fetch has renamed is made durable before anything builds on it
//! 1. manifest: signature, expiry, generation, encoder; key, generation and request are recorded
//! 2. room: shards that neither the old nor the new generation needs are removed
//! 3. each missing shard: staged, synced, hashed, checked, renamed into `shards/`; folder synced
//! 4. manifest: staged, synced, renamed into `manifests/`; folder synced
//! 5. `current`: written aside, synced, renamed; folder synced: this is the flip
//! 6. what only the old generation needed is removed

mod download;
mod error;
pub mod follow;
mod offer;
mod plan;
mod position;
mod records;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::manifest::Manifest;
use slag_common::shard::Profile;

pub use download::{Failure, NetworkLimits};
pub use error::FetchError;
pub use plan::{Held, Object, Plan, PlanError, Wanted};
pub use position::{NotAPosition, Position};
pub use records::{LastFetch, Records, RecordsError};

use crate::store::{self, Current, CurrentCell, EdgeCache, StoreError};
use download::Client;
use offer::{Offer, Trust};

/// Radius unless one is given, world units.
pub const DEFAULT_RADIUS: f64 = 50.0;
/// Downloads at a time unless a number is given.
pub const DEFAULT_PARALLEL: usize = 4;
/// More connections than this help no one.
const MAX_PARALLEL: usize = 64;

/// What to fetch.
#[derive(Clone, Debug)]
pub struct FetchRequest {
    /// Address of the store (`http://` or `https://`); absent: that of the last fetch.
    pub from: Option<String>,
    /// Where the robot is; absent: where it was at the last fetch.
    pub at: Option<Position>,
    /// How far cells matter, world units.
    pub radius: f64,
    /// How much each shard carries.
    pub profile: Profile,
    /// The only keys accepted, or those that have taken their places since; empty: the one accepted
    /// before, or, at the first contact, the server's. A key's named successor is accepted with it.
    pub keys: Vec<Hash32>,
    /// The only encoder accepted; absent: any.
    pub expected_encoder: Option<Hash32>,
    /// Bytes that shards may take; absent: twice what the cells within the radius take.
    pub max_bytes: Option<u64>,
    /// Downloads at a time.
    pub parallel: usize,
    /// Plan with the manifest and the shards on board, without network.
    pub offline: bool,
}

impl Default for FetchRequest {
    fn default() -> Self {
        Self {
            from: None,
            at: None,
            radius: DEFAULT_RADIUS,
            profile: Profile::Compact,
            keys: Vec::new(),
            expected_encoder: None,
            max_bytes: None,
            parallel: DEFAULT_PARALLEL,
            offline: false,
        }
    }
}

/// Is told how a fetch goes on, from any of its threads.
pub trait Progress: Sync {
    /// So many shards of so many bytes in all are to be downloaded.
    fn planned(&self, _n_shards: usize, _bytes: u64) {}
    /// So many bytes came in.
    fn received(&self, _bytes: u64) {}
    /// An attempt failed; another one follows.
    fn retried(&self, _url: &str, _failure: &Failure) {}
}

impl Progress for () {}

/// What a fetch takes from outside.
pub struct Environment<'a> {
    /// The clock, seconds since 1970.
    pub now_unix_secs: u64,
    /// Set by anyone who wants the fetch to end; what came in so far is resumed by the next one.
    pub cancel: &'a AtomicBool,
    /// Is told how it goes on.
    pub progress: &'a dyn Progress,
    /// Gives numbers within 0..1, to spread retries.
    pub random: &'a (dyn Fn() -> f64 + Sync),
    /// Patience with the network.
    pub limits: NetworkLimits,
}

/// Some shards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Tally {
    /// Shards.
    pub n_shards: usize,
    /// Their length.
    pub bytes: u64,
}

impl Tally {
    fn of(lengths: impl Iterator<Item = u64>) -> Self {
        lengths.fold(Self::default(), |sum, len| Self {
            n_shards: sum.n_shards + 1,
            bytes: sum.bytes.saturating_add(len),
        })
    }
}

/// What a fetch did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FetchReport {
    /// The scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// BLAKE3 of the signed manifest.
    pub manifest_hash: Hash32,
    /// The public key that signed it.
    pub key: Hash32,
    /// The key that it names as its successor; accepted from now on, too.
    pub next_key: Option<Hash32>,
    /// The key whose place this one took: no longer accepted from now on.
    pub replaced_key: Option<Hash32>,
    /// Whether the key was accepted just because it was the first.
    pub is_first_contact: bool,
    /// The encoder whose text model answers queries.
    pub encoder_id: Hash32,
    /// Its name.
    pub encoder_name: String,
    /// The profile of the shards.
    pub profile: Profile,
    /// The centre, world frame.
    pub centre_in_world: DVec3,
    /// The radius, world units.
    pub radius: f64,
    /// Cells within it.
    pub n_cells: usize,
    /// Shards that came in.
    pub downloaded: Tally,
    /// Shards that were on board and are needed.
    pub kept: Tally,
    /// Shards that are not needed but fit the budget.
    pub spare: Tally,
    /// Shards that were removed.
    pub freed: Tally,
    /// Bytes of the downloaded shards that an interrupted fetch had left.
    pub resumed_bytes: u64,
    /// Attempts beyond the first.
    pub retries: u64,
    /// Duration.
    pub seconds: f64,
}

/// Brings the shards within a radius on board and frees what is too much.
///
/// # Errors
/// [`FetchError`]; the generation before it then still answers.
pub fn fetch(
    cache: &EdgeCache,
    request: &FetchRequest,
    environment: &Environment<'_>,
) -> Result<FetchReport, FetchError> {
    let started = Instant::now();
    let dirs =
        [staging(cache), cache.dir().join("shards"), cache.dir().join("manifests"), cache.dir().into()];
    for dir in dirs.iter().rev() {
        cache.files().create_dir(dir)?;
    }
    let records = Records::open(&cache.dir().join("db"))?;
    // A fetch that was killed may have renamed files whose folder it never synced.
    for dir in &dirs {
        cache.files().sync_dir(dir)?;
    }
    let last = records.last()?;
    let (last_from, last_at) = last.map_or((None, None), |last| (Some(last.from), Some(last.at)));
    let from = request.from.clone().or(last_from).ok_or(FetchError::NotGiven { what: "store's address" })?;
    let at = request.at.or(last_at).ok_or(FetchError::NotGiven { what: "position" })?;
    let old = match cache.current() {
        Err(e @ StoreError::Current { .. }) => {
            tracing::warn!("{e}; it is written anew");
            None
        }
        other => other?,
    };
    let client = Client::new(&from, environment)?;
    let on_board = old.as_ref().and_then(|old| Offer::on_board(cache, old));
    let trust = Trust::new(&request.keys, &records, old.as_ref(), on_board.as_ref())?;
    let offer = Offer::get(&client, request.offline, on_board.as_ref(), &trust)?;
    offer.check(&records, on_board.as_ref(), &trust, request, environment.now_unix_secs)?;
    let replaced_key = trust.replaced_by(offer.key);

    let centre_in_world = at.in_world(&offer.manifest)?;
    let mut held = held_shards(cache, &records)?;
    let FetchRequest { profile, radius, max_bytes, .. } = *request;
    let wanted = Wanted { profile, centre_in_world, radius, max_bytes };
    let mut plan = Plan::new(&offer.manifest, &wanted, &held)?;
    let unfit = unfit_objects(cache, &Check::new(&offer.manifest, profile, &plan.cells), &plan.keep);
    if !unfit.is_empty() {
        held.retain(|hash, _| !unfit.contains(hash));
        plan = Plan::new(&offer.manifest, &wanted, &held)?;
    }
    let downloaded = Tally::of(plan.download.iter().map(|object| object.len_bytes));
    if request.offline && downloaded.n_shards > 0 {
        return Err(FetchError::Offline { n_shards: downloaded.n_shards, bytes: downloaded.bytes });
    }
    records.accept(&LastFetch { from, at }, &offer.manifest, offer.key, replaced_key.as_slice())?;
    if let Some(old) = replaced_key {
        tracing::info!("key {old} is no longer accepted: {} took its place", offer.key);
    }

    let in_use: BTreeSet<Hash32> = old.iter().flat_map(|old| &old.cells).map(|cell| cell.hash).collect();
    for hash in plan.free.difference(&in_use) {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    clear_staging(cache, &plan.download)?;
    environment.progress.planned(downloaded.n_shards, downloaded.bytes);
    let work = || {
        let check = Check::new(&offer.manifest, profile, &plan.cells);
        download_all(cache, &client, &check, &plan.download, request.parallel)?;
        let Offer { manifest_hash, key, .. } = offer;
        let current =
            Current { manifest_hash, key, profile, centre_in_world, radius, cells: plan.cells.clone() };
        if old.as_ref() != Some(&current) {
            put(cache, &offer.bytes, &cache.manifest_path(manifest_hash))?;
            let bytes = serde_json::to_vec(&current).map_err(io::Error::from)?;
            put(cache, &bytes, &cache.current_path())?;
        }
        Ok(())
    };
    work().map_err(|e| match e {
        FetchError::Io(source) if is_disk_full(&source) => {
            // A full disk hurts others too: give the space back, though the next fetch starts over.
            match clear_staging(cache, &[]) {
                Ok(()) => FetchError::DiskFull { needed_bytes: downloaded.bytes, source },
                Err(e) => e,
            }
        }
        other => other,
    })?;

    for hash in &plan.free {
        cache.files().remove(&cache.shard_path(*hash))?;
    }
    clear_manifests(cache, offer.manifest_hash)?;
    clear_staging(cache, &[])?;
    records.finish(plan.cells.iter().map(|cell| cell.hash), plan.free.iter().copied())?;
    let tally = |hashes: &BTreeSet<Hash32>| Tally::of(hashes.iter().map(|hash| held[hash].len_bytes));
    Ok(FetchReport {
        scene: offer.manifest.scene,
        generation: offer.manifest.generation,
        manifest_hash: offer.manifest_hash,
        key: offer.key,
        next_key: offer.manifest.next_key,
        replaced_key,
        is_first_contact: trust.is_first_contact(),
        encoder_id: offer.manifest.encoder.id,
        encoder_name: offer.manifest.encoder.name,
        profile,
        centre_in_world,
        radius,
        n_cells: plan.cells.len(),
        downloaded,
        kept: tally(&plan.keep),
        spare: tally(&plan.spare),
        freed: tally(&plan.free),
        resumed_bytes: client.resumed_bytes.into_inner(),
        retries: client.retries.into_inner(),
        seconds: started.elapsed().as_secs_f64(),
    })
}

fn staging(cache: &EdgeCache) -> PathBuf {
    cache.dir().join("staging")
}

fn part_path(cache: &EdgeCache, hash: Hash32) -> PathBuf {
    staging(cache).join(format!("{hash}.part"))
}

/// Lists the shards on board; other files among them are removed.
fn held_shards(cache: &EdgeCache, records: &Records) -> Result<BTreeMap<Hash32, Held>, FetchError> {
    let dir = cache.dir().join("shards");
    let mut held = BTreeMap::new();
    for name in cache.files().list(&dir)? {
        let path = dir.join(&name);
        match (name.parse::<Hash32>(), cache.files().stat(&path)?) {
            (Ok(hash), Some(stat)) => {
                let last_used = records.last_used(hash)?;
                held.insert(hash, Held { len_bytes: stat.len_bytes, last_used });
            }
            _ => cache.files().remove(&path)?,
        }
    }
    Ok(held)
}

/// What an object must be, beyond having its hash.
struct Check<'a> {
    manifest: &'a Manifest,
    profile: Profile,
    cells: BTreeMap<Hash32, &'a CurrentCell>,
}

impl<'a> Check<'a> {
    fn new(manifest: &'a Manifest, profile: Profile, cells: &'a [CurrentCell]) -> Self {
        Self { manifest, profile, cells: cells.iter().map(|cell| (cell.hash, cell)).collect() }
    }

    /// Checks that bytes are what the manifest says of the object: the shard of its cell.
    fn object(&self, path: &Path, hash: Hash32, bytes: &[u8]) -> Result<(), StoreError> {
        match self.cells.get(&hash) {
            Some(cell) => store::check_shard(path, bytes, cell, self.profile, self.manifest).map(drop),
            None => Ok(()),
        }
    }
}

/// Returns the objects a plan keeps that are damaged, or not what the manifest says: they must not get
/// behind `current`, and are downloaded again.
fn unfit_objects(cache: &EdgeCache, check: &Check<'_>, kept: &BTreeSet<Hash32>) -> BTreeSet<Hash32> {
    let is_unfit = |hash: &Hash32| {
        let path = cache.shard_path(*hash);
        let mapped = cache.files().map(&path).map_err(StoreError::Io);
        mapped.and_then(|bytes| check.object(&path, *hash, &bytes)).err().map(|e| (*hash, e))
    };
    let unfit: Vec<(Hash32, StoreError)> =
        store::beside_queries(|| kept.par_iter().filter_map(is_unfit).collect());
    unfit
        .into_iter()
        .map(|(hash, e)| {
            tracing::warn!("a shard on board is downloaded again: {}", crate::error_line(&e));
            hash
        })
        .collect()
}

/// Removes what lies in `staging/`, but for parts that are still wanted.
fn clear_staging(cache: &EdgeCache, wanted: &[Object]) -> Result<(), FetchError> {
    let wanted: BTreeSet<PathBuf> = wanted.iter().map(|object| part_path(cache, object.hash)).collect();
    for name in cache.files().list(&staging(cache))? {
        let path = staging(cache).join(name);
        if !wanted.contains(&path) {
            cache.files().remove(&path)?;
        }
    }
    Ok(())
}

fn clear_manifests(cache: &EdgeCache, current: Hash32) -> Result<(), FetchError> {
    let dir = cache.dir().join("manifests");
    for name in cache.files().list(&dir)? {
        if name != current.to_string() {
            cache.files().remove(&dir.join(name))?;
        }
    }
    Ok(())
}

/// Puts a small file in place, durably: under its name lies the old content or the new one, whole.
fn put(cache: &EdgeCache, bytes: &[u8], path: &Path) -> Result<(), FetchError> {
    let files = cache.files();
    let aside = staging(cache).join("put");
    files.write_from(&aside, 0, bytes)?;
    files.sync(&aside)?;
    files.rename(&aside, path)?;
    Ok(files.sync_dir(path.parent().unwrap_or(cache.dir()))?)
}

fn is_disk_full(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

/// Downloads objects, several at a time, and puts them in place, durably. Of several failures the one of
/// the first object in order is returned.
fn download_all(
    cache: &EdgeCache,
    client: &Client<'_>,
    check: &Check<'_>,
    objects: &[Object],
    parallel: usize,
) -> Result<(), FetchError> {
    let next = AtomicUsize::new(0);
    let failed = AtomicBool::new(false);
    let worker = || {
        let mut first_failure = None;
        while !failed.load(Ordering::Relaxed) {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(object) = objects.get(index) else { break };
            if let Err(e) = download_one(cache, client, check, *object) {
                failed.store(true, Ordering::Relaxed);
                first_failure = Some((index, e));
            }
        }
        first_failure
    };
    let n_workers = parallel.clamp(1, MAX_PARALLEL).min(objects.len());
    let failures = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..n_workers).map(|_| scope.spawn(worker)).collect();
        let joined = workers.into_iter().map(|worker| match worker.join() {
            Ok(failure) => failure,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        joined.collect::<Vec<_>>()
    });
    match failures.into_iter().flatten().min_by_key(|(index, _)| *index) {
        Some((_, e)) => Err(e),
        None if objects.is_empty() => Ok(()),
        None => Ok(cache.files().sync_dir(&cache.dir().join("shards"))?),
    }
}

fn download_one(
    cache: &EdgeCache,
    client: &Client<'_>,
    check: &Check<'_>,
    Object { hash, len_bytes }: Object,
) -> Result<(), FetchError> {
    let part = part_path(cache, hash);
    client.object(cache.files(), hash, len_bytes, &part)?;
    let bytes = cache.files().map(&part)?;
    if let Err(source) = check.object(&part, hash, &bytes) {
        return Err(FetchError::Published { hash, source: Box::new(source) });
    }
    Ok(cache.files().rename(&part, &cache.shard_path(hash))?)
}
