//! The store as a repository of The Update Framework: its manifest is the target `manifest`.
//!
//! | file | what |
//! |---|---|
//! | `metadata/N.root.json` | the keys of all roles |
//! | `metadata/N.targets.json` | length and hash of the manifest |
//! | `metadata/N.snapshot.json` | version of the targets metadata |
//! | `metadata/timestamp.json` | version of the snapshot, for a short time; its rename publishes the rest |

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use ed25519_dalek::SigningKey;
use serde::Serialize;
use slag_common::durable;
use slag_common::manifest::TARGET;
use slag_common::tuf::{
    Body, FileMeta, Key, MAX_ROOT_BYTES, MAX_SNAPSHOT_BYTES, MAX_TARGETS_BYTES, MAX_TIMESTAMP_BYTES, Root,
    SignedMetadata, Snapshot, TargetFile, Targets, Timestamp, TufError, format_utc, parse_utc, sign,
};

use super::{StoreError, files, reader, roles};

pub(crate) const TIMESTAMP_FILE: &str = "timestamp.json";
/// Validity of a timestamp, unless a refresh says otherwise.
pub(crate) const TIMESTAMP_DAYS: u32 = 30;
const SECS_PER_DAY: u64 = 86_400;
const TARGETS_SECS: u64 = 365 * SECS_PER_DAY;
pub(super) const ROOT_SECS: u64 = 5 * 365 * SECS_PER_DAY;
/// 2026-01-01: nothing is signed as of an earlier time, whatever a machine's clock says. What is signed as of 1970 has
/// expired before any robot sees it.
pub(super) const RELEASE_UNIX_SECS: u64 = 1_767_225_600;

/// What a signature of the timestamp states.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Refreshed {
    pub(crate) timestamp_version: u64,
    pub(crate) snapshot_version: u64,
    pub(crate) expires_unix_secs: u64,
}

pub(super) type WithBytes<T> = (SignedMetadata<T>, Vec<u8>);

/// What clients find.
struct PublishedMetadata {
    targets: Targets,
    snapshot_meta: FileMeta,
    /// First expiry of targets and snapshot.
    soonest_unix_secs: u64,
}

pub(crate) struct MetadataReader {
    pub(super) store: PathBuf,
}

/// A store's metadata, held by one writer at a time.
pub(crate) struct Metadata {
    reader: MetadataReader,
    _lock: File,
}

impl Deref for Metadata {
    type Target = MetadataReader;

    fn deref(&self) -> &MetadataReader {
        &self.reader
    }
}

impl MetadataReader {
    /// Takes no lock.
    pub(crate) fn new(store: &Path) -> Self {
        Self { store: store.to_owned() }
    }

    /// Follows a root to what clients find, whatever its expiry; `None` if a file on the way is missing or damaged, or
    /// not signed by a key in the root.
    fn published(&self, root: &Root) -> Result<Option<PublishedMetadata>, StoreError> {
        let timestamp = self.read_signed::<Timestamp>(TIMESTAMP_FILE, MAX_TIMESTAMP_BYTES, root)?;
        let Some((timestamp, _)) = timestamp else { return Ok(None) };
        let snapshot_meta = timestamp.body.snapshot().clone();
        let name = format!("{}.snapshot.json", snapshot_meta.version);
        let snapshot = self.read_signed::<Snapshot>(&name, MAX_SNAPSHOT_BYTES, root)?;
        let is_stated =
            |(found, bytes): &WithBytes<Snapshot>| FileMeta::of(found.head.version, bytes) == snapshot_meta;
        let Some((snapshot, _)) = snapshot.filter(is_stated) else { return Ok(None) };
        let stated = &snapshot.body.meta["targets.json"];
        let name = format!("{}.targets.json", stated.version);
        let targets = self.read_signed::<Targets>(&name, MAX_TARGETS_BYTES, root)?;
        let targets = targets.filter(|(found, bytes)| FileMeta::of(found.head.version, bytes) == *stated);
        let of = |(targets, _): WithBytes<Targets>| PublishedMetadata {
            soonest_unix_secs: targets.expires_unix_secs.min(snapshot.expires_unix_secs),
            targets: targets.body,
            snapshot_meta,
        };
        Ok(targets.map(of))
    }

    /// As [`Self::published`], by the newest root.
    fn published_by_newest(&self) -> Result<Option<PublishedMetadata>, StoreError> {
        let Some((root, _)) = self.newest_root()? else { return Ok(None) };
        self.published(&root.body)
    }

    /// Whether robots refuse what is published: its metadata is damaged, or not signed by the newest root's keys.
    pub(super) fn is_refused(&self) -> Result<bool, StoreError> {
        Ok(self.is_published()? && self.published_by_newest()?.is_none())
    }

    /// Targets that a root leads to, or else the store's manifest; `None` if nothing is published.
    pub(super) fn targets(&self, root: &Root) -> Result<Option<Targets>, StoreError> {
        if let Some(published) = self.published(root)? {
            return Ok(Some(published.targets));
        }
        match reader::read_manifest(&self.store.join(files::MANIFEST)) {
            Ok((_, bytes)) => Ok(Some(targets_of(&bytes))),
            Err(StoreError::NotPublished { .. } | StoreError::Manifest { .. }) => Ok(None),
            Err(e) => Err(e),
        }
    }

    /// Whether clients are led to these bytes of a manifest.
    pub(super) fn vouches_for(&self, manifest: &[u8]) -> Result<bool, StoreError> {
        Ok(self.published_by_newest()?.is_some_and(|published| published.targets == targets_of(manifest)))
    }

    /// `None` if it is missing, damaged or not signed by keys of the root.
    fn read_signed<T: Body>(
        &self,
        name: &str,
        max_bytes: u64,
        root: &Root,
    ) -> Result<Option<WithBytes<T>>, StoreError> {
        let bytes = match read_file(&self.store, name, max_bytes) {
            Err(StoreError::Metadata { .. }) => None,
            bytes => bytes?,
        };
        let Some(bytes) = bytes else { return Ok(None) };
        let Ok(found) = SignedMetadata::<T>::parse(T::TYPE, &bytes) else { return Ok(None) };
        let is_signed = found.check_signatures(T::TYPE, &root.keys, &root.roles[T::TYPE]).is_ok();
        Ok(is_signed.then_some((found, bytes)))
    }

    /// Reads metadata signed by any root of this store, newest first: clients have seen what it states.
    fn read_of_any_root<T: Body>(
        &self,
        name: &str,
        max_bytes: u64,
    ) -> Result<Option<SignedMetadata<T>>, StoreError> {
        let mut versions = self.versions(Root::TYPE)?;
        versions.sort_unstable_by(|a, b| b.cmp(a));
        for version in versions {
            let root = match self.read::<Root>(&format!("{version}.root.json"), MAX_ROOT_BYTES) {
                Err(StoreError::Metadata { .. }) => None,
                root => root?,
            };
            let Some(root) = root else { continue };
            if let Some((found, _)) = self.read_signed::<T>(name, max_bytes, &root.body)? {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    /// Whether anything was ever published, which takes a root.
    pub(super) fn is_published(&self) -> Result<bool, StoreError> {
        let is_there = |name: &&str| self.store.join(name).exists();
        Ok([files::MANIFEST, files::MANIFEST_PREVIOUS].iter().any(is_there) || self.is_begun()?)
    }

    fn is_begun(&self) -> Result<bool, StoreError> {
        let has = |role: &str| Ok::<_, StoreError>(!self.versions(role)?.is_empty());
        Ok(self.path(TIMESTAMP_FILE).exists() || has(Targets::TYPE)? || has(Snapshot::TYPE)?)
    }

    pub(super) fn timestamp(&self) -> Result<Option<SignedMetadata<Timestamp>>, StoreError> {
        self.read::<Timestamp>(TIMESTAMP_FILE, MAX_TIMESTAMP_BYTES)
    }

    /// Time at which the timestamp was signed; `None` if not by a key of the newest root, as clients forget it with its
    /// key.
    fn signed_unix_secs(&self) -> Result<Option<u64>, StoreError> {
        let Some((root, _)) = self.newest_root()? else { return Ok(None) };
        let timestamp = self.read_signed::<Timestamp>(TIMESTAMP_FILE, MAX_TIMESTAMP_BYTES, &root.body)?;
        Ok(timestamp.and_then(|(timestamp, _)| parse_utc(timestamp.body.signed_at.as_deref()?)))
    }

    /// The newest root and its bytes; `None` before the first one.
    pub(super) fn newest_root(&self) -> Result<Option<WithBytes<Root>>, StoreError> {
        let name = format!("{}.root.json", self.next_version(Root::TYPE)? - 1);
        let Some(bytes) = read_file(&self.store, &name, MAX_ROOT_BYTES)? else { return Ok(None) };
        let refuse = |cause| StoreError::Metadata { path: self.path(&name), cause };
        let root = SignedMetadata::<Root>::parse(Root::TYPE, &bytes).map_err(refuse)?;
        // A damaged one must not say which keys count.
        root.check_signatures(Root::TYPE, &root.body.keys, &root.body.roles[Root::TYPE]).map_err(refuse)?;
        Ok(Some((root, bytes)))
    }

    /// One above the highest version of a role's numbered files.
    fn next_version(&self, role: &str) -> Result<u64, StoreError> {
        Ok(self.versions(role)?.into_iter().max().unwrap_or(0).saturating_add(1))
    }

    fn versions(&self, role: &str) -> Result<Vec<u64>, StoreError> {
        let suffix = format!(".{role}.json");
        let mut versions = Vec::new();
        for name in names(&self.store)? {
            versions.extend(name.strip_suffix(&suffix).and_then(|number| number.parse::<u64>().ok()));
        }
        Ok(versions)
    }

    fn read<T: Body>(&self, name: &str, max_bytes: u64) -> Result<Option<SignedMetadata<T>>, StoreError> {
        let Some(bytes) = read_file(&self.store, name, max_bytes)? else { return Ok(None) };
        let refuse = |cause| StoreError::Metadata { path: self.path(name), cause };
        SignedMetadata::parse(T::TYPE, &bytes).map(Some).map_err(refuse)
    }

    pub(super) fn path(&self, name: &str) -> PathBuf {
        folder(&self.store).join(name)
    }

    /// What has expired or expires soon, so that robots refuse the store. Each text says until when, and what to do.
    pub(crate) fn expiry_warnings(&self, now_unix_secs: u64) -> Result<Vec<String>, StoreError> {
        let store = self.store.display();
        let expires = |what: &str, at: u64, command: &str| {
            let word = if at <= now_unix_secs { "expired" } else { "expires" };
            let at = format_utc(at);
            format!(
                "{store}: {what} metadata {word} at {at}, and robots refuse it then; run `slag-encoder {command} --store {store}`"
            )
        };
        let mut warnings = Vec::new();
        if now_unix_secs < RELEASE_UNIX_SECS {
            let (now, floor) = (format_utc(now_unix_secs), format_utc(RELEASE_UNIX_SECS));
            warnings.push(format!(
                "this machine's clock says {now}, before this program was made: {store} is signed as of {floor}; set \
                 the clock, then run `slag-encoder store refresh --store {store}`"
            ));
        } else if let Some(at) =
            self.signed_unix_secs()?.filter(|at| *at > now_unix_secs.saturating_add(SECS_PER_DAY))
        {
            let (at, now) = (format_utc(at), format_utc(now_unix_secs));
            warnings.push(format!(
                "{store} was signed as of {at}, this machine's clock says {now}: robots believe the later one, so all \
                 is signed as of it; set the clock, or, if it is right, run `slag-encoder keys rotate --store {store} \
                 timestamp` once, by which robots forget it"
            ));
        }
        let root = self.newest_root()?.map(|(root, _)| root.expires_unix_secs);
        if let Some(at) = root.filter(|at| *at < now_unix_secs.saturating_add(ROOT_SECS / 10)) {
            warnings.push(expires("root", at, "keys renew"));
        }
        let timestamp = self.timestamp()?.map(|timestamp| timestamp.expires_unix_secs);
        if let Some(at) = timestamp.filter(|at| *at < now_unix_secs.saturating_add(3 * SECS_PER_DAY)) {
            warnings.push(expires("timestamp", at, "store refresh"));
        }
        Ok(warnings)
    }
}

impl Metadata {
    /// Opens the metadata for writing; waits for another signature, but not for an encode.
    pub(crate) fn open(store: &Path) -> Result<Self, StoreError> {
        let folder = folder(store);
        files::ensure_folder(&folder)?;
        let path = folder.join("lock");
        let file = fs_err::OpenOptions::new().write(true).create(true).truncate(false).open(&path)?;
        let lock = file.into_parts().0;
        lock.lock().map_err(|e| io::Error::new(e.kind(), format!("locking {}: {e}", path.display())))?;
        Ok(Self { reader: MetadataReader::new(store), _lock: lock })
    }

    /// Makes keys and root before the first publication. `created_unix_secs`: as of [`Self::publish`].
    pub(crate) fn ensure_root(&self, created_unix_secs: u64) -> Result<(), StoreError> {
        if self.newest_root()?.is_some() {
            return Ok(());
        }
        let now_unix_secs = created_unix_secs.max(signing_unix_secs());
        self.make_root(&roles::root_folder(&self.store), 1, 1, now_unix_secs)
    }

    /// Refuses a store without a root.
    pub(crate) fn check_root(&self) -> Result<(), StoreError> {
        match self.newest_root()? {
            Some(_) => Ok(()),
            None => Err(StoreError::RootLost { path: self.path("1.root.json") }),
        }
    }

    /// Publishes a manifest, unless it is published already. `created_unix_secs`: of the manifest; a later clock counts
    /// instead, because a reproducible manifest may be dated back.
    pub(crate) fn publish(&self, manifest: &[u8], created_unix_secs: u64) -> Result<(), StoreError> {
        self.check_root()?;
        let now_unix_secs = created_unix_secs.max(signing_unix_secs());
        let targets = targets_of(manifest);
        match self.published_by_newest()? {
            Some(published) if published.targets == targets => return Ok(()),
            None if self.is_begun()? => tracing::warn!(
                "{}: what robots follow is damaged or missing; it is signed anew",
                folder(&self.store).display()
            ),
            _ => {}
        }
        self.sign_all(&targets, now_unix_secs).map(drop)
    }

    /// Checks that the next publication can be signed, before hours of work.
    pub(crate) fn check_keys(&self) -> Result<(), StoreError> {
        match self.newest_root()? {
            Some(_) => roles::ONLINE.into_iter().try_for_each(|role| self.key(role).map(drop)),
            None if self.is_published()? => self.check_root(),
            None => roles::check_before_root(&self.store),
        }
    }

    /// Signs the timestamp anew; the rest if half of its time is over, or if it is damaged or missing. Never needs
    /// root's key.
    ///
    /// # Errors
    /// [`StoreError::NotPublished`] before the first publication; [`StoreError`] otherwise.
    pub(crate) fn refresh(&self, now_unix_secs: u64, days: u32) -> Result<Refreshed, StoreError> {
        let published = match self.published_by_newest()? {
            Some(published) => published,
            None => {
                let path = self.store.join(files::MANIFEST);
                let (manifest, bytes) = reader::read_manifest(&path)?;
                self.publish(&bytes, manifest.created_unix_secs.max(now_unix_secs))?;
                self.published_by_newest()?.ok_or(StoreError::NotPublished { path })?
            }
        };
        let snapshot_meta = match published.soonest_unix_secs < now_unix_secs.saturating_add(TARGETS_SECS / 2)
        {
            true => self.sign_all(&published.targets, now_unix_secs)?,
            false => published.snapshot_meta,
        };
        self.sign_timestamp(snapshot_meta, now_unix_secs, days, false)
    }

    /// Makes keys and the first root, with `n_root_keys` of them in `root_folder`.
    pub(crate) fn make_root(
        &self,
        root_folder: &Path,
        n_root_keys: usize,
        threshold: u32,
        now_unix_secs: u64,
    ) -> Result<(), StoreError> {
        if self.newest_root()?.is_some() {
            return Err(StoreError::Failed(format!(
                "{} has a root already; to change its keys, run `slag-encoder keys rotate` or `revoke`",
                self.store.display()
            )));
        }
        if self.is_published()? {
            // Robots trust a root of this store, and a new one of its version would not follow it.
            return self.check_root();
        }
        let (body, keys) = roles::make_all(&self.store, root_folder, n_root_keys, threshold)?;
        let keys: Vec<&SigningKey> = keys.iter().collect();
        let bytes = sign(1, now_unix_secs.saturating_add(ROOT_SECS), &body, &keys);
        self.write("1.root.json", &bytes)?;
        tracing::info!(
            "the store's root of trust is {}; its keys lie in {}, which can be kept elsewhere",
            self.path("1.root.json").display(),
            root_folder.display()
        );
        Ok(())
    }

    /// Signs targets, snapshot and timestamp; returns the timestamp's entry for the snapshot. No version goes back,
    /// neither behind existing files nor behind what they state of missing ones.
    pub(super) fn sign_all(&self, targets: &Targets, now_unix_secs: u64) -> Result<FileMeta, StoreError> {
        let expires = now_unix_secs.saturating_add(TARGETS_SECS);
        let timestamp = self.read_of_any_root::<Timestamp>(TIMESTAMP_FILE, MAX_TIMESTAMP_BYTES)?;
        let snapshot_before = timestamp.map_or(0, |timestamp| timestamp.body.snapshot().version);
        let newest = snapshot_before.max(self.next_version(Snapshot::TYPE)? - 1);
        let name = format!("{newest}.snapshot.json");
        let snapshot = self.read_of_any_root::<Snapshot>(&name, MAX_SNAPSHOT_BYTES)?;
        let targets_before = snapshot.map_or(0, |snapshot| snapshot.body.meta["targets.json"].version);

        let version = self.next_version(Targets::TYPE)?.max(targets_before.saturating_add(1));
        let bytes = sign(version, expires, targets, &[&self.key(Targets::TYPE)?]);
        self.write(&format!("{version}.targets.json"), &bytes)?;
        let mut is_first = version == 1;
        let meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(version, &bytes))]);
        let version = self.next_version(Snapshot::TYPE)?.max(snapshot_before.saturating_add(1));
        let bytes = sign(version, expires, &Snapshot { meta }, &[&self.key(Snapshot::TYPE)?]);
        self.write(&format!("{version}.snapshot.json"), &bytes)?;
        is_first &= version == 1;
        let meta = FileMeta::of(version, &bytes);
        self.sign_timestamp(meta.clone(), now_unix_secs, TIMESTAMP_DAYS, is_first)?;
        Ok(meta)
    }

    /// Never signs as of an earlier time than before with the same key: clients that saw the later one take it for the
    /// present, and refuse what has expired by then. `is_first`: no timestamp was ever signed.
    fn sign_timestamp(
        &self,
        snapshot: FileMeta,
        now: u64,
        days: u32,
        is_first: bool,
    ) -> Result<Refreshed, StoreError> {
        let before = self.read_of_any_root::<Timestamp>(TIMESTAMP_FILE, MAX_TIMESTAMP_BYTES)?;
        let timestamp_version = match before {
            Some(before) => before.head.version.saturating_add(1),
            None if is_first => 1,
            // The previous version is lost, and robots refuse a lower one: no store signs more than once a second.
            None => now.max(signing_unix_secs()),
        };
        let now = now.max(self.signed_unix_secs()?.unwrap_or(0));
        let expires_unix_secs = now.saturating_add(u64::from(days) * SECS_PER_DAY);
        let snapshot_version = snapshot.version;
        let meta = BTreeMap::from([("snapshot.json".to_owned(), snapshot)]);
        let body = Timestamp { meta, signed_at: Some(format_utc(now)) };
        let key = self.key(Timestamp::TYPE)?;
        self.write(TIMESTAMP_FILE, &sign(timestamp_version, expires_unix_secs, &body, &[&key]))?;
        Ok(Refreshed { timestamp_version, snapshot_version, expires_unix_secs })
    }

    /// A role's key, if the newest root names it: another one's signature would lock clients out.
    fn key(&self, role: &str) -> Result<SigningKey, StoreError> {
        let wrong = || StoreError::RoleKey { role: role.to_owned(), path: folder(&self.store) };
        let (root, _) = self.newest_root()?.ok_or_else(wrong)?;
        // A crash after the root was installed may have left the key behind.
        roles::promote(&self.store, role, &root.body)?;
        let key = roles::read(&self.store, role)?;
        if root.body.roles[role].keyids.contains(&Key::of(&key).id()) { Ok(key) } else { Err(wrong()) }
    }

    pub(super) fn write(&self, name: &str, bytes: &[u8]) -> Result<(), StoreError> {
        Ok(durable::write(&self.path(name), bytes)?)
    }
}

pub(crate) fn clock_unix_secs() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

/// Time of signatures: the system's, but never before this program was made.
pub(crate) fn signing_unix_secs() -> u64 {
    signing_time(clock_unix_secs())
}

pub(super) fn signing_time(clock_unix_secs: u64) -> u64 {
    clock_unix_secs.max(RELEASE_UNIX_SECS)
}

/// Reads a metadata file by the name that clients ask for; `None` if there is no such file.
pub(crate) fn read_published(store: &Path, name: &str) -> Result<Option<Vec<u8>>, StoreError> {
    let max_bytes = match name.split_once('.') {
        Some(("timestamp", "json")) => MAX_TIMESTAMP_BYTES,
        // Numbers have one spelling, so that no name leaves the folder.
        Some((version, role)) if version.parse().is_ok_and(|v: u64| v.to_string() == version) => match role {
            "root.json" => MAX_ROOT_BYTES,
            "snapshot.json" => MAX_SNAPSHOT_BYTES,
            "targets.json" => MAX_TARGETS_BYTES,
            _ => return Ok(None),
        },
        _ => return Ok(None),
    };
    read_file(store, name, max_bytes)
}

fn read_file(store: &Path, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, StoreError> {
    let path = folder(store).join(name);
    files::read_limited(&path, max_bytes, |_| {
        let cause = TufError::TooLong { what: name.to_owned(), max_bytes };
        StoreError::Metadata { path: path.clone(), cause }
    })
}

/// File names in a store's metadata folder; none without the folder.
pub(super) fn names(store: &Path) -> io::Result<Vec<String>> {
    let Some(entries) = files::if_there(fs_err::read_dir(folder(store)))? else { return Ok(Vec::new()) };
    entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned())).collect()
}

fn targets_of(manifest: &[u8]) -> Targets {
    Targets { targets: BTreeMap::from([(TARGET.to_owned(), TargetFile::of(manifest))]) }
}

pub(super) fn folder(store: &Path) -> PathBuf {
    store.join("metadata")
}
