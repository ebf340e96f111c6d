//! A repository in memory, as written by its owner or by a thief of keys.

use super::*;

use ed25519_dalek::SigningKey;
use slag_common::tuf::{RoleKeys, Root, Source, TargetFile, Timestamp, Trusted, format_utc};

/// The clock of the tests, and the default expiry of metadata.
pub const NOW: u64 = 1_800_000_000;
pub const EXPIRES: u64 = NOW + 86_400;
pub const PATH: &str = "scene/manifest";

pub fn key(n: u8) -> SigningKey {
    SigningKey::from_bytes(&[n; 32])
}

#[derive(Clone)]
pub struct Owner {
    pub root: Vec<SigningKey>,
    pub root_threshold: u32,
    pub targets: SigningKey,
    pub snapshot: SigningKey,
    pub timestamp: SigningKey,
}

impl Default for Owner {
    fn default() -> Self {
        let root = vec![key(1), key(2), key(3)];
        Self { root, root_threshold: 2, targets: key(4), snapshot: key(5), timestamp: key(6) }
    }
}

impl Owner {
    pub fn root_body(&self) -> Root {
        let mut keys = BTreeMap::new();
        let mut role = |signers: &[SigningKey], threshold| {
            let signers: Vec<Key> = signers.iter().map(Key::of).collect();
            keys.extend(signers.iter().map(|key| (key.id(), key.clone())));
            RoleKeys { keyids: signers.iter().map(Key::id).collect(), threshold }
        };
        let roles = BTreeMap::from([
            ("root".to_owned(), role(&self.root, self.root_threshold)),
            ("targets".to_owned(), role(std::slice::from_ref(&self.targets), 1)),
            ("snapshot".to_owned(), role(std::slice::from_ref(&self.snapshot), 1)),
            ("timestamp".to_owned(), role(std::slice::from_ref(&self.timestamp), 1)),
        ]);
        Root { consistent_snapshot: true, keys, roles }
    }

    pub fn sign_root(&self, version: u64, expires: u64, others: &[SigningKey]) -> Vec<u8> {
        let signers: Vec<&SigningKey> = self.root.iter().chain(others).collect();
        sign(version, expires, &self.root_body(), &signers)
    }
}

/// Files of a repository; records what was read.
#[derive(Clone, Default)]
pub struct Repo {
    pub owner: Owner,
    pub files: BTreeMap<String, Vec<u8>>,
    pub root_version: u64,
    pub version: u64,
    pub timestamp_version: u64,
    pub expires: u64,
    pub reads: Vec<(String, u64)>,
}

impl Repo {
    /// All roles at version 1.
    pub fn new() -> Self {
        let mut repo = Self { root_version: 1, expires: EXPIRES, ..Self::default() };
        repo.put("1.root.json", repo.owner.sign_root(1, EXPIRES, &[]));
        repo.publish(b"one");
        repo
    }

    pub fn put(&mut self, name: &str, bytes: Vec<u8>) {
        self.files.insert(name.to_owned(), bytes);
    }

    pub fn root(&self) -> &[u8] {
        &self.files["1.root.json"]
    }

    /// Publishes the next version of targets, snapshot and timestamp.
    pub fn publish(&mut self, content: &[u8]) {
        let targets = BTreeMap::from([(PATH.to_owned(), TargetFile::of(content))]);
        self.publish_targets(self.version + 1, &Targets { targets });
    }

    pub fn publish_targets(&mut self, version: u64, targets: &Targets) {
        let bytes = sign(version, self.expires, targets, &[&self.owner.targets]);
        let meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(version, &bytes))]);
        self.put(&format!("{version}.targets.json"), bytes);
        self.publish_snapshot(version, meta);
    }

    pub fn publish_snapshot(&mut self, version: u64, meta: BTreeMap<String, FileMeta>) {
        self.version = version;
        let bytes = sign(version, self.expires, &Snapshot { meta }, &[&self.owner.snapshot]);
        self.put(&format!("{version}.snapshot.json"), bytes);
        self.sign_timestamp();
    }

    pub fn sign_timestamp(&mut self) {
        let meta = FileMeta::of(self.version, &self.files[&format!("{}.snapshot.json", self.version)]);
        self.timestamp_version += 1;
        self.sign_timestamp_as(self.timestamp_version, meta, NOW);
    }

    pub fn sign_timestamp_as(&mut self, version: u64, snapshot: FileMeta, signed_unix_secs: u64) {
        let meta = BTreeMap::from([("snapshot.json".to_owned(), snapshot)]);
        let body = Timestamp { meta, signed_at: Some(format_utc(signed_unix_secs)) };
        self.put("timestamp.json", sign(version, self.expires, &body, &[&self.owner.timestamp]));
    }

    /// Publishes the next root with other keys, also signed by the present root's keys.
    pub fn rotate(&mut self, next: Owner) {
        self.root_version += 1;
        let bytes = next.sign_root(self.root_version, EXPIRES, &self.owner.root);
        self.put(&format!("{}.root.json", self.root_version), bytes);
        self.owner = next;
    }

    /// Signs everything again with the present keys.
    pub fn publish_again(&mut self, content: &[u8], version: u64, timestamp_version: u64) {
        self.timestamp_version = timestamp_version - 1;
        self.version = version - 1;
        self.publish(content);
    }
}

impl Source for Repo {
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String> {
        self.reads.push((name.to_owned(), max_bytes));
        Ok(self.files.get(name).map(|bytes| bytes.iter().copied().take(max_bytes as usize + 1).collect()))
    }
}

/// A client that trusts the first root.
pub fn client(repo: &Repo) -> Kept {
    Kept::from_root(repo.root()).expect("a root")
}

pub fn update(kept: &mut Kept, repo: &mut Repo) -> Result<Trusted, TufError> {
    refresh(kept, repo, NOW)
}

pub fn updated(repo: &mut Repo) -> Kept {
    let mut kept = client(repo);
    update(&mut kept, repo).expect("an honest repository");
    kept
}

pub fn role_of(error: &TufError) -> &str {
    match error {
        TufError::Signatures { role, .. }
        | TufError::Rollback { role, .. }
        | TufError::Version { role, .. }
        | TufError::Expired { role, .. }
        | TufError::Format { role, .. } => role,
        TufError::Content { what, .. } | TufError::TooLong { what, .. } | TufError::Missing { what } => what,
        _ => "",
    }
}
