//! Downloads shards, several at a time, checks them against the manifest and renames them into place.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rayon::prelude::*;
use slag_common::Hash32;
use slag_common::manifest::Manifest;
use slag_common::shard::Profile;

use super::download::Client;
use super::error::FetchError;
use super::plan::Object;
use super::staging::part_path;
use crate::store::{self, CurrentCell, EdgeCache, StoreError};

/// Most connections at a time.
const MAX_PARALLEL: usize = 64;

/// Checks of an object beyond its hash.
pub struct Check<'a> {
    manifest: &'a Manifest,
    profile: Profile,
    cells: BTreeMap<Hash32, &'a CurrentCell>,
}

impl<'a> Check<'a> {
    pub fn new(manifest: &'a Manifest, profile: Profile, cells: &'a [CurrentCell]) -> Self {
        Self { manifest, profile, cells: cells.iter().map(|cell| (cell.hash, cell)).collect() }
    }

    /// Checks that bytes are the shard that the manifest describes.
    fn object(&self, path: &Path, hash: Hash32, bytes: &[u8]) -> Result<(), StoreError> {
        match self.cells.get(&hash) {
            Some(cell) => store::check_shard(path, bytes, cell, self.profile, self.manifest).map(drop),
            None => Ok(()),
        }
    }
}

/// Returns the objects of a plan that are damaged or differ from the manifest. They are downloaded again, so
/// that `current` never names them.
pub fn unfit_objects(cache: &EdgeCache, check: &Check<'_>, kept: &BTreeSet<Hash32>) -> BTreeSet<Hash32> {
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
            tracing::warn!("downloading a shard again: {}", crate::error_line(&e));
            hash
        })
        .collect()
}

/// Downloads objects, several at a time, and puts them in place durably. Of several errors, returns that of
/// the first object.
pub fn download_all(
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
