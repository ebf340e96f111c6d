//! Damaged metadata: it is told, and signed anew where that is safe. The oracle is the client of `slag-common`.

use std::path::{Path, PathBuf};

use slag_common::tuf::Trusted;

use super::ceremony::{Change, default_root_folder};
use super::metadata::{Metadata, clock_unix_secs};
use super::metadata_tests::{client, follow, publish_in as publish};
use super::tests::DAMAGES;
use super::{Fault, StoreError, StoreReader, export, verify};

/// A store with two generations and two roots, and a refreshed timestamp.
fn store() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("temporary folder");
    publish(dir.path(), 1).expect("publishes");
    let metadata = Metadata::open(dir.path()).expect("opens");
    let rotate = Change::Roles(vec!["timestamp".to_owned()]);
    metadata.change_keys(&rotate, &default_root_folder(dir.path()), clock_unix_secs()).expect("rotates");
    drop(metadata);
    publish(dir.path(), 2).expect("publishes");
    for _ in 0..3 {
        Metadata::open(dir.path()).and_then(|m| m.refresh(clock_unix_secs(), 9)).expect("signs");
    }
    dir
}

fn newest(dir: &Path, role: &str) -> PathBuf {
    let folder = dir.join("metadata");
    let of = |version: u32| folder.join(format!("{version}.{role}.json"));
    let newest = (1..9).rev().map(of).find(|path| path.exists());
    newest.unwrap_or_else(|| folder.join(format!("{role}.json")))
}

/// Each file that a robot needs, removed, cut and changed: `verify` names it and what helps, and `export` writes
/// nothing.
#[test]
fn what_robots_would_refuse_is_told() {
    let sound = store();
    assert_eq!(verify::refused(sound.path()).expect("reads"), []);
    let roles = ["timestamp", "snapshot", "targets", "root"];
    let mut paths: Vec<PathBuf> = roles.map(|role| newest(sound.path(), role)).into();
    paths.push(sound.path().join("metadata/1.root.json"));
    for path in &paths {
        let bytes = fs_err::read(path).expect("there");
        for (number, damage) in DAMAGES.iter().enumerate() {
            damage(path);
            let case = format!("{}, damage {number}", path.display());
            let reader = StoreReader::open(sound.path()).expect("published");
            let bad = reader.verify(|| {}).bad;
            assert_eq!(bad.len(), 1, "{case}: {bad:?}");
            // A missing newest root shows in what its keys signed.
            let is_gone_root = number == 0 && path.ends_with("2.root.json");
            assert!(is_gone_root || bad[0].path == *path, "{case}: {bad:?}");
            let Fault::Refused(what) = &bad[0].fault else { panic!("{case}: {bad:?}") };
            let is_root = bad[0].path.to_string_lossy().ends_with(".root.json");
            let help = if is_root { "v1/metadata/ of what" } else { "slag-encoder store refresh" };
            assert!(what.contains(help), "{case}: {what}");
            let out = sound.path().join("out");
            let exported = export(sound.path(), &out);
            assert!(matches!(exported, Err(StoreError::Refused { .. })), "{case}: {exported:?}");
            assert!(!out.exists(), "{case}");
            fs_err::write(path, &bytes).expect("written");
        }
    }
    let manifest = sound.path().join("manifest");
    let older = fs_err::read(sound.path().join("manifest.previous")).expect("there");
    fs_err::write(&manifest, older).expect("written");
    let [refused] = &verify::refused(sound.path()).expect("reads")[..] else { panic!("one") };
    assert_eq!(refused.path, manifest);
}

/// Whatever of timestamp, snapshot and targets is lost or damaged, a refresh or the next generation signs it anew, and
/// a robot that saw the state before follows.
#[test]
fn metadata_is_signed_anew_and_no_version_goes_back() {
    for role in ["timestamp", "snapshot", "targets"] {
        for (number, damage) in DAMAGES.iter().enumerate() {
            for by_refresh in [true, false] {
                let case = format!("{role}, damage {number}, by refresh: {by_refresh}");
                let dir = store();
                let mut kept = client(dir.path());
                let before = follow(&mut kept, dir.path(), clock_unix_secs()).expect("follows");
                damage(&newest(dir.path(), role));
                match by_refresh {
                    true => drop(
                        Metadata::open(dir.path())
                            .and_then(|m| m.refresh(clock_unix_secs(), 9))
                            .unwrap_or_else(|e| panic!("{case}: {e}")),
                    ),
                    false => publish(dir.path(), 3).unwrap_or_else(|e| panic!("{case}: {e}")),
                }
                assert_eq!(verify::refused(dir.path()).expect("reads"), [], "{case}");
                let after = follow(&mut kept, dir.path(), clock_unix_secs()).expect("follows");
                let versions = |trusted: &Trusted| {
                    let [timestamp, snapshot, targets] = [
                        trusted.timestamp().map(|file| file.head.version),
                        trusted.snapshot().map(|file| file.head.version),
                        trusted.targets().map(|file| file.head.version),
                    ];
                    [timestamp, snapshot, targets].map(|version| version.expect("there"))
                };
                let (before, after) = (versions(&before), versions(&after));
                assert!(before.iter().zip(&after).all(|(before, after)| before < after), "{case}: {after:?}");
            }
        }
    }
}

/// A new root would replace the one that robots trust: people must decide this.
#[test]
fn a_lost_root_is_not_made_anew_in_silence() {
    let dir = store();
    let aside = tempfile::tempdir().expect("a folder");
    for name in ["1.root.json", "2.root.json"] {
        fs_err::rename(dir.path().join("metadata").join(name), aside.path().join(name)).expect("there");
    }
    let refused = publish(dir.path(), 3).expect_err("no root");
    assert!(matches!(refused, StoreError::RootLost { .. }), "{refused}");
    assert!(refused.to_string().contains("v1/metadata/"), "{refused}");
    let status = Metadata::open(dir.path()).and_then(|metadata| metadata.keys_status(dir.path()));
    let status = status.expect_err("no root");
    assert!(matches!(status, StoreError::RootLost { .. }), "{status}");
    // Nor where nothing but manifests, or the catalogue, tell that robots trust one.
    for lost in [&["metadata"][..], &["manifest", "manifest.previous"]] {
        lost.iter()
            .for_each(|name| fs_err::rename(dir.path().join(name), aside.path().join(name)).expect("there"));
        let refused = publish(dir.path(), 3).expect_err("no root");
        assert!(matches!(refused, StoreError::RootLost { .. }), "{refused}");
        let refreshed =
            Metadata::open(dir.path()).and_then(|metadata| metadata.refresh(clock_unix_secs(), 9));
        assert!(matches!(refreshed, Err(StoreError::RootLost { .. } | StoreError::NotPublished { .. })));
    }
    for name in ["metadata", "manifest", "manifest.previous"] {
        let _ = fs_err::remove_dir_all(dir.path().join(name));
        fs_err::rename(aside.path().join(name), dir.path().join(name)).expect("restores");
    }
    for name in ["1.root.json", "2.root.json"] {
        fs_err::rename(aside.path().join(name), dir.path().join("metadata").join(name)).expect("restores");
    }
    publish(dir.path(), 3).expect("as the error says");
}
