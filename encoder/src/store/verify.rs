//! Reads every byte of what a store publishes, and follows its metadata as a robot does.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rayon::prelude::*;
use serde::Serialize;
use slag_common::Hash32;
use slag_common::manifest::{Manifest, ShardRecord, TARGET, TextModelRecord};
use slag_common::tuf::{Trusted, TufError};

use super::metadata::{self, TIMESTAMP_FILE, clock_unix_secs, folder, names, read_published};
use super::reader::{Extras, StoreReader};
use super::{StoreError, files, metadata_fault, metadata_help};

/// Objects of the current and the previous generation: content of each, by hash and length if a manifest states it.
type Listing = BTreeMap<(Hash32, Option<u64>), Vec<String>>;

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Fault {
    Missing,
    /// Its content has another hash or length than the manifest lists.
    Damaged,
    /// It cannot be read; the system's error.
    Unreadable(String),
    /// Robots refuse it: why, and what helps.
    Refused(String),
}

/// A file that robots or queries would fail on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct BadFile {
    /// Of an object; absent of the manifest and of metadata.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) hash: Option<Hash32>,
    pub(crate) path: PathBuf,
    pub(crate) fault: Fault,
    /// What an object holds, such as `cell 3, balanced, generation 2`.
    pub(crate) holds: Vec<String>,
}

/// What was read, and what of it is bad.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Verified {
    /// Objects that the current generation and the one before it list.
    pub(crate) n_files: usize,
    pub(crate) len_bytes: u64,
    /// Bad objects, by hash; then what robots refuse of metadata and manifest.
    pub(crate) bad: Vec<BadFile>,
}

impl StoreReader {
    pub(crate) fn listing(&self) -> Listing {
        let mut listing = Listing::new();
        for published in std::iter::once(self.current()).chain(self.previous()) {
            let generation = published.manifest.generation;
            for (hash, len_bytes, what) in contents(&published.manifest, &published.extras) {
                let holds = format!("{what}, generation {generation}");
                listing.entry((hash, len_bytes)).or_default().push(holds);
            }
        }
        listing
    }

    /// Reads every object, several at a time, and the metadata. `on_read`: called after each, from any thread.
    pub(crate) fn verify(&self, on_read: impl Fn() + Sync) -> Verified {
        let listing = self.listing();
        let bytes_read = AtomicU64::new(0);
        let check = |((hash, len_bytes), holds): (&(Hash32, Option<u64>), &Vec<String>)| {
            let path = self.object_path(*hash);
            let fault = match files::hash_of(&path) {
                Ok((found, n)) => {
                    bytes_read.fetch_add(n, Ordering::Relaxed);
                    let is_sound = found == *hash && len_bytes.is_none_or(|expected| expected == n);
                    (!is_sound).then_some(Fault::Damaged)
                }
                Err(e) if e.kind() == io::ErrorKind::NotFound => Some(Fault::Missing),
                Err(e) => Some(Fault::Unreadable(e.to_string())),
            };
            on_read();
            fault.map(|fault| BadFile { hash: Some(*hash), path, fault, holds: holds.clone() })
        };
        let mut bad: Vec<BadFile> = listing.par_iter().filter_map(check).collect();
        let of = |path, fault| BadFile { hash: None, path, fault, holds: Vec::new() };
        let store = self.dir();
        match refused(store) {
            Ok(refused) => {
                bad.extend(refused.into_iter().map(|Refused { path, what }| of(path, Fault::Refused(what))))
            }
            Err(e) => bad.push(of(metadata::folder(store), Fault::Unreadable(e.to_string()))),
        }
        Verified { n_files: listing.len(), len_bytes: bytes_read.into_inner(), bad }
    }
}

/// A generation's objects: hash, length if the manifest states it, and content.
pub(super) fn contents(manifest: &Manifest, extras: &Extras) -> Vec<(Hash32, Option<u64>, String)> {
    let shards = manifest.cells.iter().flat_map(|cell| {
        let of_profile = |(profile, shard): (&_, &ShardRecord)| {
            (shard.hash, Some(shard.len_bytes), format!("cell {}, {profile}", cell.cell_id))
        };
        cell.shards.iter().map(of_profile).collect::<Vec<_>>()
    });
    let text_model = manifest.encoder.text_model.iter().flat_map(TextModelRecord::objects);
    let text_model = text_model.map(|object| (object.hash, Some(object.len_bytes), "text model".to_owned()));
    let extras = extras.iter().map(|(name, hash)| (*hash, None, name.clone()));
    shards.chain(text_model).chain(extras).collect()
}

/// Reads of metadata before a fault counts, with a pause between them: an encode or refresh replaces it file by file.
pub(super) const N_TRIES: usize = 3;
pub(super) const PAUSE: Duration = Duration::from_millis(if cfg!(test) { 1 } else { 200 });

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Refused {
    pub(super) path: PathBuf,
    /// The fault, and what helps.
    pub(super) what: String,
}

/// A store's metadata files by name, or the error of reading one.
pub(super) type MetadataFiles = BTreeMap<String, Result<Vec<u8>, TufError>>;

pub(super) fn read_all(store: &Path) -> Result<MetadataFiles, StoreError> {
    let mut found = MetadataFiles::new();
    for name in names(store)? {
        match read_published(store, &name) {
            Ok(bytes) => found.extend(bytes.map(|bytes| (name, Ok(bytes)))),
            Err(StoreError::Metadata { cause, .. }) => drop(found.insert(name, Err(cause))),
            Err(e) => return Err(e),
        }
    }
    Ok(found)
}

/// What a robot would refuse of a store now.
pub(super) fn refused(store: &Path) -> Result<Vec<Refused>, StoreError> {
    for n_tries in 1.. {
        let metadata = read_all(store)?;
        let manifest = files::read_manifest_bytes(&store.join(files::MANIFEST))?.unwrap_or_default();
        let found = refused_of(store, &metadata, &manifest, clock_unix_secs());
        if found.is_empty() || n_tries == N_TRIES {
            return Ok(found);
        }
        std::thread::sleep(PAUSE);
    }
    Ok(Vec::new())
}

pub(super) fn refused_of(
    store: &Path,
    metadata: &MetadataFiles,
    manifest: &[u8],
    now_unix_secs: u64,
) -> Vec<Refused> {
    let mut walk = Walk { store, metadata, found: Vec::new() };
    if let Some(mut trusted) = walk.roots(now_unix_secs) {
        // The first refusal ends a robot's fetch, and nothing after it is known.
        let _ = walk.follow(&mut trusted, manifest);
    }
    walk.found
}

struct Walk<'a> {
    store: &'a Path,
    metadata: &'a MetadataFiles,
    found: Vec<Refused>,
}

/// The walk ended; the reason is recorded.
struct Ended;

impl Walk<'_> {
    /// Follows all roots: robots may know any of them, and new ones ask for the first. Returns the newest, unless
    /// refused.
    fn roots(&mut self, now_unix_secs: u64) -> Option<Trusted> {
        let version = |name: &String| name.strip_suffix(".root.json")?.parse::<u64>().ok();
        let mut versions: Vec<u64> = self.metadata.keys().filter_map(version).collect();
        versions.sort_unstable();
        let (mut trusted, mut expected) = (None::<Trusted>, 1);
        for version in versions {
            if version != expected {
                let _ = self.refuse(&format!("{expected}.root.json"), &missing("root"));
                trusted = None;
            }
            expected = version.saturating_add(1);
            let name = format!("{version}.root.json");
            let followed = self.get(&name).and_then(|bytes| match trusted.take() {
                Some(mut before) => before.add_root(bytes).map(|()| before),
                None => Trusted::new(bytes, now_unix_secs),
            });
            trusted = followed.map_err(|cause| self.refuse(&name, &cause)).ok();
        }
        if expected == 1 {
            let _ = self.refuse("1.root.json", &missing("root"));
        }
        trusted
    }

    /// Follows timestamp, snapshot and targets to the manifest.
    fn follow(&mut self, trusted: &mut Trusted, manifest: &[u8]) -> Result<(), Ended> {
        let root = trusted.root();
        let name = format!("{}.root.json", root.head.version);
        let is_current = root.check_expiry("root", trusted.now_unix_secs());
        is_current.map_err(|cause| self.refuse(&name, &cause))?;
        self.step(TIMESTAMP_FILE.into(), |bytes| trusted.add_timestamp(bytes).map(drop))?;
        let stated = trusted.timestamp().map_or(0, |timestamp| timestamp.body.snapshot().version);
        self.step(format!("{stated}.snapshot.json"), |bytes| trusted.add_snapshot(bytes, None))?;
        let stated = trusted.snapshot().map_or(0, |snapshot| snapshot.body.meta["targets.json"].version);
        self.step(format!("{stated}.targets.json"), |bytes| trusted.add_targets(bytes))?;
        let listed = trusted.target(TARGET).ok_or(missing(TARGET));
        let checked = listed.and_then(|target| target.check(TARGET, manifest));
        checked.map_err(|cause| self.refuse(TARGET, &cause))
    }

    fn step(&mut self, name: String, add: impl FnOnce(&[u8]) -> Result<(), TufError>) -> Result<(), Ended> {
        self.get(&name).and_then(add).map_err(|cause| self.refuse(&name, &cause))
    }

    fn get(&self, name: &str) -> Result<&[u8], TufError> {
        match self.metadata.get(name) {
            None => Err(missing(name)),
            Some(Ok(bytes)) => Ok(bytes),
            Some(Err(cause)) => Err(cause.clone()),
        }
    }

    /// `name`: of a metadata file, or the manifest's.
    fn refuse(&mut self, name: &str, cause: &TufError) -> Ended {
        let fault = metadata_fault(cause);
        let refused = if name == TARGET {
            let path = self.store.join(files::MANIFEST);
            let what = format!("{fault}; run `slag-encoder encode` again, which publishes it anew");
            Refused { path, what }
        } else {
            let path = folder(self.store).join(name);
            let help = match cause {
                TufError::Expired { role, .. } if role == "root" => "run `slag-encoder keys renew`",
                _ => metadata_help(&path),
            };
            Refused { what: format!("{fault}; {help}"), path }
        };
        self.found.push(refused);
        Ended
    }
}

fn missing(what: &str) -> TufError {
    TufError::Missing { what: what.to_owned() }
}
