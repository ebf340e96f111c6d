//! A valid TUF repository in which one role's file is replaced.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use ed25519_dalek::SigningKey;
use slag_common::tuf::{FileMeta, Root, SignedMetadata, Snapshot, Timestamp, one_key_repository, sign};

pub fn key() -> SigningKey {
    SigningKey::from_bytes(&[7; 32])
}

/// Roles state versions only, so that each file may be replaced.
pub fn repository() -> &'static BTreeMap<String, Vec<u8>> {
    static FILES: OnceLock<BTreeMap<String, Vec<u8>>> = OnceLock::new();
    FILES.get_or_init(|| {
        let (key, never) = (key(), u64::MAX);
        let mut files = one_key_repository(&key, 1, "manifest", b"x");
        let root = SignedMetadata::<Root>::parse("root", &files["1.root.json"]).expect("valid").body;
        let meta = |name: &str| {
            BTreeMap::from([(name.to_owned(), FileMeta { version: 1, length: None, hashes: None })])
        };
        let snapshot = Snapshot { meta: meta("targets.json") };
        let timestamp = Timestamp { meta: meta("snapshot.json"), signed_at: None };
        files.insert("2.root.json".into(), sign(2, never, &root, &[&key]));
        files.insert("1.snapshot.json".into(), sign(1, never, &snapshot, &[&key]));
        files.insert("timestamp.json".into(), sign(1, never, &timestamp, &[&key]));
        files
    })
}

/// Files by the first byte of an input.
pub const REPLACED: [&str; 4] = ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json"];

/// A seed for each role: its byte, and its signed content.
pub fn seeds() -> Vec<Vec<u8>> {
    let seed = |(number, name): (usize, &&str)| {
        let text = String::from_utf8(repository()[*name].clone()).expect("JSON is text");
        let at = text.find("\"signed\":").expect("signed") + "\"signed\":".len();
        [&[b'0' + number as u8], &text.as_bytes()[at..text.len() - 1]].concat()
    };
    REPLACED.iter().enumerate().map(seed).collect()
}
