//! Downloads shards, several at a time, checks them against the manifest and renames them into place.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use slag_common::Hash32;
use slag_common::manifest::{Manifest, ObjectRecord, TextModelRecord};
use slag_common::shard::Profile;
use slag_models::download::DownloadFailure;

use super::download::Client;
use super::error::FetchError;
use super::offer::Offer;
use super::staging::part_path;
use crate::store::files::is_bad_medium;
use crate::store::{self, CellFault, CurrentCell, EdgeCache, Listed, StoreError};

const MAX_PARALLEL: usize = 64;

/// Checks of an object beyond its hash.
pub struct Check<'a> {
    pub manifest: &'a Manifest,
    pub profile: Profile,
    cells: BTreeMap<Hash32, &'a CurrentCell>,
    text_model: BTreeSet<Hash32>,
}

impl<'a> Check<'a> {
    pub fn new(manifest: &'a Manifest, profile: Profile, cells: &'a [CurrentCell]) -> Self {
        let text_model = manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects);
        let text_model = text_model.map(|object| object.hash).collect();
        Self { manifest, profile, cells: cells.iter().map(|cell| (cell.hash, cell)).collect(), text_model }
    }

    pub(crate) fn is_of_text_model(&self, hash: Hash32) -> bool {
        self.text_model.contains(&hash)
    }

    pub fn cell(&self, hash: Hash32) -> Option<&'a CurrentCell> {
        self.cells.get(&hash).copied()
    }

    fn listed(&self, at: &'a CurrentCell) -> Listed<'a> {
        Listed { manifest: self.manifest, profile: self.profile, at }
    }

    /// Returns whether an object on board is what the manifest describes. It is read only if its own manifest
    /// described it otherwise: readers find and mark rot.
    pub(crate) fn is_fit(&self, cache: &EdgeCache, on_board: Option<&Offer>, hash: Hash32) -> bool {
        let Some(cell) = self.cell(hash) else { return true };
        let described = |manifest: &Manifest| {
            let listed = store::cell_of(manifest, cell.cell_id)?;
            let shard = listed.shards.get(&self.profile)?;
            Some((shard.hash, listed.n_gaussians, manifest.encoder.dim, manifest.encoder.id))
        };
        on_board.is_some_and(|before| described(&before.manifest) == described(self.manifest))
            || self.listed(cell).check_file(cache).is_ok()
    }

    /// Checks that bytes are the manifest's shard or text-model file.
    pub fn object(&self, path: &Path, hash: Hash32, bytes: &[u8]) -> Result<(), StoreError> {
        if let Some(cell) = self.cell(hash) {
            return self.listed(cell).check(path, bytes).map(drop);
        }
        StoreError::check_hash(path, hash, bytes)
    }
}

/// Unavailable objects by hash, with fault and error; and those in place.
#[derive(Default)]
pub struct Downloaded {
    pub bad: BTreeMap<Hash32, (CellFault, FetchError)>,
    pub good: BTreeSet<Hash32>,
}

/// Returns the fault of a cell, if an error is about its shard alone: the store answers, but not with that shard.
fn fault_of(error: &FetchError) -> Option<CellFault> {
    match error {
        FetchError::Published { .. } => Some(CellFault::Invalid),
        // Neither read nor replaced.
        FetchError::Io(e) if is_bad_medium(e) => Some(CellFault::Unreadable),
        FetchError::Download { failure, .. } => match failure {
            DownloadFailure::Hash { .. } | DownloadFailure::Length { .. } => Some(CellFault::Damaged),
            // 500: a store that cannot read the object.
            DownloadFailure::Status { status: 404 | 410 | 500, .. } => Some(CellFault::Missing),
            _ => None,
        },
        _ => None,
    }
}

/// Downloads objects, several at a time, and puts them in place durably. An object that the store does not have whole
/// costs that object only; of several other errors, returns that of the first object.
pub fn download_all(
    cache: &EdgeCache,
    client: &Client<'_>,
    check: &Check<'_>,
    objects: &[ObjectRecord],
    parallel: usize,
) -> Result<Downloaded, FetchError> {
    let next = AtomicUsize::new(0);
    let failed = AtomicBool::new(false);
    let downloaded = Mutex::new(Downloaded::default());
    let downloaded_now = || downloaded.lock().unwrap_or_else(PoisonError::into_inner);
    let worker = || {
        let mut first_failure = None;
        while !failed.load(Ordering::Relaxed) {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(object) = objects.get(index) else { break };
            match download_one(cache, client, check, *object) {
                Ok(()) => drop(downloaded_now().good.insert(object.hash)),
                Err(e) => match fault_of(&e) {
                    Some(fault) => drop(downloaded_now().bad.insert(object.hash, (fault, e))),
                    None => {
                        failed.store(true, Ordering::Relaxed);
                        first_failure = Some((index, e));
                    }
                },
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
    if let Some((_, e)) = failures.into_iter().flatten().min_by_key(|(index, _)| *index) {
        return Err(e);
    }
    let downloaded = downloaded.into_inner().unwrap_or_else(PoisonError::into_inner);
    if !downloaded.good.is_empty() {
        cache.files().sync_dir(&cache.dir().join("shards"))?;
    }
    Ok(downloaded)
}

fn download_one(
    cache: &EdgeCache,
    client: &Client<'_>,
    check: &Check<'_>,
    ObjectRecord { hash, len_bytes }: ObjectRecord,
) -> Result<(), FetchError> {
    let part = part_path(cache, hash);
    client.object(cache.files(), hash, len_bytes, &part)?;
    let bytes = cache.files().read(&part, len_bytes)?;
    if let Err(source) = check.object(&part, hash, &bytes) {
        // It would be the same next time.
        cache.files().remove(&part)?;
        return Err(FetchError::Published { hash, source: Box::new(source) });
    }
    Ok(cache.files().rename(&part, &cache.shard_path(hash))?)
}
