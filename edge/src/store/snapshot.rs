//! An open generation: a manifest and its shards, mapped and checked.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;
use slag_common::Hash32;
use slag_common::manifest::{CellRecord, Manifest};
use slag_common::shard::Profile;

use super::cache::{BadCell, CellFault, Current, CurrentCell, EdgeCache, can_stand_in};
use super::error::StoreError;
use super::files::Stat;
use super::objects::ObjectIndex;
use super::shard::{Listed, OpenShard};

/// Attempts of a reader while fetches replace `current`.
const MAX_RACES: usize = 16;

/// An open generation, unaffected by later fetches.
#[derive(Debug)]
pub struct Snapshot {
    pub current: Current,
    /// State of `current` just before it was read, for comparison with [`EdgeCache::current_stat`].
    pub current_stat: Option<Stat>,
    pub manifest: Manifest,
    /// The shards, by cell id, ascending; shared with snapshots of other generations that list them.
    pub shards: Vec<Arc<OpenShard>>,
    /// Cells within the radius with unavailable shards; some have an earlier generation's shard.
    pub bad_cells: Vec<BadCell>,
    /// Whether a shard failed to open for a passing reason, such as too many open files.
    pub may_recover: bool,
    pub objects: ObjectIndex,
}

impl Snapshot {
    /// Returns the cells without a shard on board.
    pub fn not_fetched(&self) -> impl Iterator<Item = &CellRecord> {
        let mut shards = self.shards.iter().map(|shard| shard.cell.cell_id).peekable();
        self.manifest.cells.iter().filter(move |cell| {
            while shards.next_if(|id| *id < cell.cell_id).is_some() {}
            shards.peek() != Some(&cell.cell_id)
        })
    }

    /// Opens the current generation: maps and checks every shard once. One that does not open costs its cell only,
    /// and is marked for the next fetch.
    ///
    /// # Errors
    /// [`StoreError`]; that of the first shard if none opens. A fetch that replaces `current` meanwhile is not an
    /// error.
    pub fn open(cache: &EdgeCache) -> Result<Self, StoreError> {
        Self::open_after(cache, None)
    }

    /// As [`Snapshot::open`], but shards that a snapshot of the same cache has open are not mapped or checked again.
    pub fn open_after(cache: &EdgeCache, before: Option<&Self>) -> Result<Self, StoreError> {
        let mut seen = None;
        for _ in 0..MAX_RACES {
            let current_stat = cache.current_stat()?;
            let current =
                cache.current()?.ok_or_else(|| StoreError::Empty { path: cache.dir().to_owned() })?;
            // A fetch removes the old files after replacing `current`.
            let is_settled = seen.as_ref() == Some(&current);
            match Self::open_current(cache, current.clone(), current_stat, before, is_settled) {
                Err(StoreError::Missing { .. }) if !is_settled => seen = Some(current),
                other => return other,
            }
        }
        let what = format!("it was replaced {MAX_RACES} times while it was being opened");
        Err(StoreError::Current { path: cache.current_path(), what })
    }

    fn open_current(
        cache: &EdgeCache,
        current: Current,
        current_stat: Option<Stat>,
        before: Option<&Self>,
        is_settled: bool,
    ) -> Result<Self, StoreError> {
        let manifest = cache.read_manifest(current.manifest_hash)?;
        let held = before.map_or(&[][..], |before| &before.shards);
        let opener = Opener { cache, profile: current.profile, marked: cache.marked_as_damaged(), held };
        let opened: Vec<Result<Arc<OpenShard>, StoreError>> =
            beside_queries(|| current.cells.par_iter().map(|cell| opener.open(&manifest, cell)).collect());
        let (mut shards, mut failures) = (Vec::with_capacity(opened.len()), Vec::new());
        for (cell, opened) in current.cells.iter().zip(opened) {
            match opened {
                Ok(shard) => shards.push(shard),
                // The fault of `current`, or of a late reader, not of the shard.
                Err(e @ StoreError::Unlisted { .. }) => return Err(e),
                Err(e @ StoreError::Missing { .. }) if !is_settled => return Err(e),
                Err(e) => failures.push((cell, e)),
            }
        }
        let may_recover = failures.iter().any(|(_, e)| matches!(e, StoreError::Io(_)));
        let mut bad_cells = current.bad_cells.clone();
        for bad in &mut bad_cells {
            match opener.stand_in(&manifest, bad) {
                Some(shard) => shards.push(shard),
                None => bad.old = None,
            }
        }
        for (cell, e) in &failures {
            if e.is_damage() {
                cache.mark_damaged(cell.hash);
            }
            tracing::warn!("cell {} does not answer: {}", cell.cell_id, crate::error_line(e));
            bad_cells.push(BadCell { cell_id: cell.cell_id, fault: CellFault::Unreadable, old: None });
        }
        match failures.into_iter().next() {
            Some((_, e)) if shards.is_empty() => return Err(e),
            _ => {}
        }
        bad_cells.sort_by_key(|bad| bad.cell_id);
        shards.sort_by_key(|shard| shard.cell.cell_id);
        let objects = shards.iter().map(|shard| shard.additions().objects).collect::<Vec<_>>();
        let objects = ObjectIndex::new(&objects);
        Ok(Self { current, current_stat, manifest, shards, bad_cells, may_recover, objects })
    }

    pub fn unreadable(&self) -> impl Iterator<Item = Hash32> + '_ {
        let cells = self.bad_cells.iter().filter(|bad| bad.fault == CellFault::Unreadable);
        cells.filter_map(|bad| {
            let at = self.current.cells.binary_search_by_key(&bad.cell_id, |cell| cell.cell_id).ok()?;
            Some(self.current.cells[at].hash)
        })
    }
}

struct Opener<'a> {
    cache: &'a EdgeCache,
    profile: Profile,
    marked: BTreeSet<Hash32>,
    /// Open shards of an earlier snapshot, by cell.
    held: &'a [Arc<OpenShard>],
}

impl Opener<'_> {
    fn open(&self, manifest: &Manifest, cell: &CurrentCell) -> Result<Arc<OpenShard>, StoreError> {
        let Self { cache, profile, .. } = *self;
        let listed = Listed { manifest, profile, at: cell };
        if self.marked.contains(&cell.hash) {
            return Err(StoreError::Damaged { path: cache.shard_path(cell.hash) });
        }
        let held = self.held.binary_search_by_key(&cell.cell_id, |shard| shard.cell.cell_id);
        let held = held.ok().map(|at| &self.held[at]);
        match held.filter(|shard| shard.is(cache, &listed)) {
            Some(shard) => Ok(Arc::clone(shard)),
            None => listed.open(cache).map(Arc::new),
        }
    }

    /// Opens the shard of an earlier generation that answers for a bad cell.
    fn stand_in(&self, manifest: &Manifest, bad: &BadCell) -> Option<Arc<OpenShard>> {
        let old = bad.old?;
        let cell = old.of_cell(bad.cell_id);
        let opened = self.cache.read_manifest(old.manifest_hash).and_then(|of_old| {
            let may_stand_in = can_stand_in(&of_old, manifest, bad.cell_id);
            may_stand_in.then(|| self.open(&of_old, &cell)).transpose()
        });
        // One cell fewer; the next fetch retries it.
        let warn = |e: &StoreError| {
            tracing::warn!("cell {} has no shard: {}", bad.cell_id, crate::error_line(e));
        };
        opened.inspect_err(warn).ok().flatten()
    }
}

/// Runs work in parallel on a separate pool of half the cores.
///
/// Queries use the global pool; a query queued there behind the checks of many shards would wait for all of them.
pub(crate) fn beside_queries<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    static POOL: OnceLock<Option<rayon::ThreadPool>> = OnceLock::new();
    let pool = POOL.get_or_init(|| {
        let n_threads = std::thread::available_parallelism().map_or(1, usize::from).div_ceil(2);
        rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().ok()
    });
    match pool {
        Some(pool) => pool.install(work),
        // Serial, if there is no memory for threads.
        None => work(),
    }
}
