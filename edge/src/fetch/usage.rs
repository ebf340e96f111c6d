//! Which shards fetches needed and checked, in sled. What is lost here costs time only: shards are freed in
//! another order, and checked once more. So nothing of it fails a fetch, and a damaged database is made anew.

use std::collections::{BTreeMap, BTreeSet};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use slag_common::Hash32;

/// sled's page cache; the records take a few kilobytes.
const CACHE_BYTES: u64 = 1 << 20;
/// A fetch that just ended may hold sled's lock a moment longer: sled releases it on a thread of its own.
const LOCK_TIMEOUT: Duration = Duration::from_secs(2);
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Why the database is of no use.
enum Fault {
    /// Another program holds it.
    Busy,
    /// It is damaged, or its folder cannot be used.
    Failed(String),
}

impl From<sled::Error> for Fault {
    fn from(e: sled::Error) -> Self {
        match e {
            // sled has no error variant for this.
            sled::Error::Io(e) if e.to_string().contains("could not acquire lock") => Self::Busy,
            e => Self::Failed(e.to_string()),
        }
    }
}

/// The database.
struct Tables {
    db: sled::Db,
    used: sled::Tree,
    checked: sled::Tree,
}

/// A shard that was checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Checked {
    /// Digest of the file's state and of what the manifest says about the shard.
    pub digest: Hash32,
    /// Time of the check, seconds since 1970.
    pub unix_secs: u64,
}

/// The records of use.
pub struct Usage {
    dir: PathBuf,
    tables: Option<Tables>,
    /// Number of the last fetch.
    count: u64,
    used: BTreeMap<Hash32, u64>,
    checked: BTreeMap<Hash32, Checked>,
}

impl Usage {
    /// Opens the records; makes them anew if they are damaged, and goes on without if that fails.
    pub fn open(dir: PathBuf) -> Self {
        let mut usage = Self { dir, tables: None, count: 0, used: BTreeMap::new(), checked: BTreeMap::new() };
        match usage.load() {
            Ok(()) => return usage,
            Err(Fault::Busy) => {
                tracing::warn!("{} is in use; this fetch keeps no record of use", usage.dir.display());
                return usage;
            }
            Err(Fault::Failed(what)) => {
                tracing::warn!("{} is made anew: {what}", usage.dir.display());
            }
        }
        usage.reset();
        if let Err(Fault::Failed(what)) = remove(&usage.dir).and_then(|()| usage.load()) {
            tracing::warn!("{}: {what}; this fetch keeps no record of use", usage.dir.display());
            usage.reset();
        }
        usage
    }

    fn reset(&mut self) {
        (self.tables, self.count) = (None, 0);
        self.used.clear();
        self.checked.clear();
    }

    fn load(&mut self) -> Result<(), Fault> {
        let dir = self.dir.clone();
        let (tables, count, used, checked) = guarded(move || {
            let tables = open(&dir)?;
            let count = tables.db.get("fetches")?.map_or(Ok(0), |bytes| number(&bytes))?;
            let mut used = BTreeMap::new();
            for pair in &tables.used {
                let (name, value) = pair?;
                used.insert(hash(&name)?, number(&value)?);
            }
            let mut checked = BTreeMap::new();
            for pair in &tables.checked {
                let (name, value) = pair?;
                let (digest, unix_secs) =
                    value.split_at_checked(32).ok_or_else(|| Fault::Failed("a short record".into()))?;
                checked
                    .insert(hash(&name)?, Checked { digest: hash(digest)?, unix_secs: number(unix_secs)? });
            }
            Ok((tables, count, used, checked))
        })?;
        (self.tables, self.count, self.used, self.checked) = (Some(tables), count, used, checked);
        Ok(())
    }

    /// Returns the number of the last fetch that needed a shard; 0 if unknown.
    pub fn last_used(&self, shard: Hash32) -> u64 {
        self.used.get(&shard).copied().unwrap_or(0)
    }

    /// Returns the last check of a shard.
    pub fn checked(&self, shard: Hash32) -> Option<Checked> {
        self.checked.get(&shard).copied()
    }

    /// Records the shards that a fetch needed, those that it checked, and those still on board; others are
    /// forgotten.
    pub fn finish(
        &mut self,
        needed: &BTreeSet<Hash32>,
        checked: &BTreeMap<Hash32, Hash32>,
        on_board: &BTreeSet<Hash32>,
        now_unix_secs: u64,
    ) {
        self.count = self.count.saturating_add(1);
        let Some(tables) = &self.tables else { return };
        let count = self.count.to_le_bytes();
        let written = guarded(|| {
            tables.db.insert("fetches", &count)?;
            for shard in needed {
                tables.used.insert(shard.0, &count)?;
            }
            for (shard, digest) in checked {
                tables.checked.insert(shard.0, [&digest.0[..], &now_unix_secs.to_le_bytes()].concat())?;
            }
            for gone in self.used.keys().filter(|shard| !on_board.contains(shard)) {
                tables.used.remove(gone.0)?;
            }
            for gone in self.checked.keys().filter(|shard| !on_board.contains(shard)) {
                tables.checked.remove(gone.0)?;
            }
            tables.db.flush()?;
            Ok(())
        });
        if let Err(Fault::Failed(what)) = written {
            tracing::warn!("{}: {what}; this fetch keeps no record of use", self.dir.display());
        }
    }
}

fn open(dir: &Path) -> Result<Tables, Fault> {
    let config = sled::Config::new().path(dir).cache_capacity(CACHE_BYTES).flush_every_ms(None);
    let start = Instant::now();
    loop {
        match config.open().map_err(Fault::from) {
            Ok(db) => {
                let (used, checked) = (db.open_tree("used")?, db.open_tree("checked")?);
                return Ok(Tables { db, used, checked });
            }
            Err(Fault::Busy) if start.elapsed() <= LOCK_TIMEOUT => std::thread::sleep(LOCK_PAUSE),
            Err(fault) => return Err(fault),
        }
    }
}

/// Runs work on a database that may be damaged: sled panics on some damage.
fn guarded<T>(work: impl FnOnce() -> Result<T, Fault>) -> Result<T, Fault> {
    catch_unwind(AssertUnwindSafe(work))
        .unwrap_or_else(|_| Err(Fault::Failed("the database panicked".into())))
}

fn remove(dir: &Path) -> Result<(), Fault> {
    match fs_err::remove_dir_all(dir) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Fault::Failed(e.to_string())),
        _ => Ok(()),
    }
}

fn hash(bytes: &[u8]) -> Result<Hash32, Fault> {
    bytes.try_into().map(Hash32).map_err(|_| Fault::Failed("a hash of another length".into()))
}

fn number(bytes: &[u8]) -> Result<u64, Fault> {
    bytes.try_into().map(u64::from_le_bytes).map_err(|_| Fault::Failed("a number of another length".into()))
}
