//! Checks the shards on board. A file that was checked and has not changed is not read again at every fetch; the
//! medium may still rot, so each is checked again after a day, a limited number of bytes a fetch.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, SystemTime};

use rayon::prelude::*;
use slag_common::Hash32;

use super::objects::Check;
use super::usage::{Checked, Usage};
use crate::store::files::Stat;
use crate::store::{self, EdgeCache, StoreError};

/// Time after which an unchanged file is checked again.
const SCRUB_AFTER_SECS: u64 = 24 * 3600;
/// Most bytes of unchanged files that a fetch checks again.
const SCRUB_BYTES: u64 = 64 << 20;
/// A file changed so recently that its time may not show a further change.
const RECENT: Duration = Duration::from_millis(100);

/// The result of checking shards on board.
#[derive(Default)]
pub struct Scrubbed {
    /// Shards that are damaged or differ from the manifest. They are downloaded again, so that `current` never
    /// names them.
    pub unfit: BTreeSet<Hash32>,
    /// Shards that were read and are sound.
    pub sound: BTreeSet<Hash32>,
}

/// Checks the objects of a plan that are on board. `damaged`: those that readers marked; they are not read.
pub fn scrub(
    cache: &EdgeCache,
    check: &Check<'_>,
    kept: &BTreeSet<Hash32>,
    damaged: &BTreeSet<Hash32>,
    usage: &Usage,
    now_unix_secs: u64,
) -> Scrubbed {
    let mut due = Vec::new();
    let mut unchanged = Vec::new();
    for hash in kept.difference(damaged) {
        let digest = digest(cache, check, *hash);
        match usage.checked(*hash).filter(|checked| Some(checked.digest) == digest) {
            Some(checked) => unchanged.push((*hash, checked)),
            None => due.push(*hash),
        }
    }
    due.extend(overdue(check, unchanged, now_unix_secs));
    let fault = |hash: &Hash32| {
        let path = cache.shard_path(*hash);
        let mapped = cache.files().map(&path).map_err(StoreError::Io);
        (*hash, mapped.and_then(|bytes| check.object(&path, *hash, &bytes)).err())
    };
    let faults: Vec<_> = store::beside_queries(|| due.par_iter().map(fault).collect());
    let mut scrubbed = Scrubbed { unfit: kept & damaged, ..Scrubbed::default() };
    for (hash, fault) in faults {
        match fault {
            Some(e) => {
                tracing::warn!("downloading an object again: {}", crate::error_line(&e));
                scrubbed.unfit.insert(hash);
            }
            None => drop(scrubbed.sound.insert(hash)),
        }
    }
    scrubbed
}

/// Returns the unchanged files to check again: those checked longest ago, within the budget.
fn overdue(check: &Check<'_>, mut unchanged: Vec<(Hash32, Checked)>, now_unix_secs: u64) -> Vec<Hash32> {
    // A clock that was set back makes them due too.
    unchanged.retain(|(_, checked)| checked.unix_secs.abs_diff(now_unix_secs) > SCRUB_AFTER_SECS);
    unchanged.sort_by_key(|(hash, checked)| (checked.unix_secs, *hash));
    let mut left_bytes = Some(SCRUB_BYTES);
    let within_budget = |(hash, _): &(Hash32, Checked)| {
        let is_left = left_bytes.is_some();
        let len_bytes = check.len_bytes(*hash).unwrap_or(0);
        // The first that does not fit is still checked, so that a long shard is at all.
        left_bytes = left_bytes.and_then(|left| left.checked_sub(len_bytes));
        is_left
    };
    unchanged.into_iter().take_while(within_budget).map(|(hash, _)| hash).collect()
}

/// Returns the digests of shards that were just checked, for [`Usage::finish`].
pub fn digests(
    cache: &EdgeCache,
    check: &Check<'_>,
    sound: impl Iterator<Item = Hash32>,
) -> BTreeMap<Hash32, Hash32> {
    sound.filter_map(|hash| Some((hash, digest(cache, check, hash)?))).collect()
}

/// Returns the digest of a file's state and of what the manifest says about the shard; `None` if the file may
/// change without its state showing it.
fn digest(cache: &EdgeCache, check: &Check<'_>, hash: Hash32) -> Option<Hash32> {
    let Stat { len_bytes, modified, inode } = cache.files().stat(&cache.shard_path(hash)).ok()??;
    let modified = modified?;
    SystemTime::now().duration_since(modified).ok().filter(|age| *age > RECENT)?;
    let nanos = modified.duration_since(SystemTime::UNIX_EPOCH).ok()?.as_nanos();
    if check.is_of_text_model(hash) {
        let numbers = [len_bytes, inode].map(u64::to_le_bytes).concat();
        return Some(Hash32::of(&[&hash.0[..], &nanos.to_le_bytes(), &numbers].concat()));
    }
    let cell = check.cell(hash)?;
    let listed = store::cell_of(check.manifest, cell.cell_id)?;
    let encoder = &check.manifest.encoder;
    let numbers = [len_bytes, inode, cell.len_bytes, u64::from(cell.cell_id)];
    let more = [listed.n_gaussians, encoder.dim];
    let mut bytes =
        [&hash.0[..], &encoder.id.0, &nanos.to_le_bytes(), check.profile.name().as_bytes()].concat();
    bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
    bytes.extend(more.iter().flat_map(|number| number.to_le_bytes()));
    Some(Hash32::of(&bytes))
}
