//! A valid TUF repository in which one role's file is replaced.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use ed25519_dalek::SigningKey;
use slag_common::tuf::{FileMeta, Key, RoleKeys, Root, Snapshot, TargetFile, Targets, Timestamp, sign};

pub fn key() -> SigningKey {
    SigningKey::from_bytes(&[7; 32])
}

/// Roles state versions only, so that each file may be replaced.
pub fn repository() -> &'static BTreeMap<&'static str, Vec<u8>> {
    static FILES: OnceLock<BTreeMap<&'static str, Vec<u8>>> = OnceLock::new();
    FILES.get_or_init(|| {
        let (key, never) = (key(), u64::MAX);
        let public = Key::of(&key);
        let role = RoleKeys { keyids: vec![public.id()], threshold: 1 };
        let roles = ["root", "targets", "snapshot", "timestamp"].map(|name| (name.to_owned(), role.clone()));
        let keys = BTreeMap::from([(public.id(), public)]);
        let root = Root { consistent_snapshot: true, keys, roles: roles.into() };
        let meta = |name: &str| {
            BTreeMap::from([(name.to_owned(), FileMeta { version: 1, length: None, hashes: None })])
        };
        let targets = BTreeMap::from([("manifest".to_owned(), TargetFile::of(b"x"))]);
        let targets = Targets { targets };
        let snapshot = Snapshot { meta: meta("targets.json") };
        let timestamp = Timestamp { meta: meta("snapshot.json"), signed_at: None };
        BTreeMap::from([
            ("1.root.json", sign(1, never, &root, &[&key])),
            ("2.root.json", sign(2, never, &root, &[&key])),
            ("timestamp.json", sign(1, never, &timestamp, &[&key])),
            ("1.snapshot.json", sign(1, never, &snapshot, &[&key])),
            ("1.targets.json", sign(1, never, &targets, &[&key])),
        ])
    })
}

/// Files by the first byte of an input.
pub const REPLACED: [&str; 4] = ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json"];

/// A seed for each role: its byte, and its signed content.
pub fn seeds() -> Vec<Vec<u8>> {
    let seed = |(number, name): (usize, &&str)| {
        let text = String::from_utf8(repository()[name].clone()).expect("JSON is text");
        let at = text.find("\"signed\":").expect("signed") + "\"signed\":".len();
        [&[b'0' + number as u8], &text.as_bytes()[at..text.len() - 1]].concat()
    };
    REPLACED.iter().enumerate().map(seed).collect()
}
