//! Walks the metadata of a store as a robot does, from the first root to the manifest, and says what a robot would
//! refuse.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use slag_common::manifest::TARGET;
use slag_common::tuf::{Trusted, TufError};

use super::error::{StoreError, metadata_fault, metadata_help};
use super::files;
use super::metadata::{TIMESTAMP_FILE, clock_unix_secs, folder, names, read_published};

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
    let mut n_tries = 0;
    loop {
        let metadata = read_all(store)?;
        let manifest = files::read_manifest_bytes(&store.join(files::MANIFEST))?.unwrap_or_default();
        let found = refused_of(store, &metadata, &manifest, clock_unix_secs());
        n_tries += 1;
        if found.is_empty() || n_tries == N_TRIES {
            return Ok(found);
        }
        std::thread::sleep(PAUSE);
    }
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
        self.metadata.get(name).map_or_else(
            || Err(missing(name)),
            |read| match read {
                Ok(bytes) => Ok(&bytes[..]),
                Err(cause) => Err(cause.clone()),
            },
        )
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
