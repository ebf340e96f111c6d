//! The smallest repository: one target, one key for all roles. For benchmarks and tests.

use std::collections::BTreeMap;

use ed25519_dalek::SigningKey;

use super::metadata::{FileMeta, Key, RoleKeys, Root, Snapshot, TargetFile, Targets, Timestamp};
use super::signed::sign;

/// Returns metadata by file name. `version` applies to all roles but root, which stays the same.
pub fn one_key_repository(
    key: &SigningKey,
    version: u64,
    path: &str,
    target: &[u8],
) -> BTreeMap<String, Vec<u8>> {
    let never = u64::MAX;
    let public = Key::of(key);
    let role = RoleKeys { keyids: vec![public.id()], threshold: 1 };
    let roles = ["root", "targets", "snapshot", "timestamp"].map(|name| (name.to_owned(), role.clone()));
    let keys = BTreeMap::from([(public.id(), public)]);
    let root = Root { consistent_snapshot: true, keys, roles: roles.into() };
    let targets = BTreeMap::from([(path.to_owned(), TargetFile::of(target))]);
    let targets = sign(version, never, &Targets { targets }, &[key]);
    let meta = BTreeMap::from([("targets.json".to_owned(), FileMeta::of(version, &targets))]);
    let snapshot = sign(version, never, &Snapshot { meta }, &[key]);
    let meta = BTreeMap::from([("snapshot.json".to_owned(), FileMeta::of(version, &snapshot))]);
    let timestamp = sign(version, never, &Timestamp { meta, signed_at: None }, &[key]);
    BTreeMap::from([
        ("1.root.json".to_owned(), sign(1, never, &root, &[key])),
        ("timestamp.json".to_owned(), timestamp),
        (format!("{version}.snapshot.json"), snapshot),
        (format!("{version}.targets.json"), targets),
    ])
}
