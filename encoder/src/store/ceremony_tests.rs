//! Changes of keys; the oracle is the client of `slag-common`.

use slag_common::tuf::TufError;
use slag_test_support::assert_error;

use super::ceremony::{Change, default_root_folder, sign_draft};
use super::metadata::{Metadata, clock_unix_secs};
use super::metadata_tests::{client, follow, publish_in as publish};
use super::tests::manifest as manifest_of;
use super::{Extras, Store, StoreError};

fn roles(names: &[&str]) -> Change {
    Change::Roles(names.iter().map(|name| (*name).to_owned()).collect())
}

#[test]
fn robots_follow_every_change_of_keys() {
    let dir = tempfile::tempdir().expect("temporary folder");
    publish(dir.path(), 1).expect("publishes");
    let (mut kept, mut sleeper) = (client(dir.path()), client(dir.path()));
    let root_keys = default_root_folder(dir.path());
    let all = ["root", "targets", "snapshot", "timestamp"];
    let changes = [&all[3..], &all[2..3], &all[1..2], &all[..1], &all];
    for (version, names) in (2u64..).zip(changes) {
        follow(&mut kept, dir.path(), clock_unix_secs()).expect("before");
        let metadata = Metadata::open(dir.path()).expect("opens");
        let before = metadata.keys_status(&root_keys).expect("a root").keys;
        let changed = metadata.change_keys(&roles(names), &root_keys, clock_unix_secs()).expect("signs");
        assert_eq!((changed.root_version, changed.draft), (version, None));
        let after = metadata.keys_status(&root_keys).expect("a root").keys;
        for (old, new) in before.iter().zip(&after) {
            assert_eq!(old.id != new.id, names.contains(&old.role.as_str()), "{names:?}: {}", old.role);
            assert!(new.is_here, "{}", new.role);
        }
        drop(metadata);
        publish(dir.path(), version).expect("publishes");
        follow(&mut kept, dir.path(), clock_unix_secs()).unwrap_or_else(|e| panic!("{names:?}: {e}"));
    }
    follow(&mut sleeper, dir.path(), clock_unix_secs()).expect("follows all roots at once");
}

/// Interrupted after the new root was written, before the new keys signed anything.
#[test]
fn an_interrupted_change_of_keys_is_mended_by_the_next() {
    let dir = tempfile::tempdir().expect("temporary folder");
    publish(dir.path(), 1).expect("publishes");
    let mut kept = client(dir.path());
    let (root_keys, folder) = (default_root_folder(dir.path()), dir.path().join("metadata"));
    let metadata = Metadata::open(dir.path()).expect("opens");
    let read = |name: &str| (folder.join(name), fs_err::read(folder.join(name)).expect("reads"));
    let before = ["timestamp.json", "1.snapshot.json", "1.targets.json"].map(read);
    metadata
        .change_keys(&roles(&["targets", "snapshot", "timestamp"]), &root_keys, clock_unix_secs())
        .expect("signs");
    for name in ["2.snapshot.json", "2.targets.json"] {
        fs_err::remove_file(folder.join(name)).expect("removed");
    }
    before.iter().for_each(|(path, bytes)| fs_err::write(path, bytes).expect("written"));
    assert!(
        metadata.is_refused().expect("read") && follow(&mut kept, dir.path(), clock_unix_secs()).is_err()
    );
    metadata.change_keys(&roles(&[]), &root_keys, clock_unix_secs()).expect("signs");
    assert!(!metadata.is_refused().expect("read"));
    follow(&mut kept, dir.path(), clock_unix_secs()).expect("follows");
}

/// Two of three root keys must sign; each is on another machine.
#[test]
fn a_draft_is_carried_to_the_root_keys() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let (store, usb) = (dir.path().join("store"), dir.path().join("usb"));
    fs_err::create_dir(&store).expect("made");
    Metadata::open(&store).and_then(|m| m.make_root(&usb, 3, 2, clock_unix_secs())).expect("made");
    publish(&store, 1).expect("publishes");
    assert!(!default_root_folder(&store).exists(), "the store never has a root key");
    let mut kept = client(&store);
    follow(&mut kept, &store, clock_unix_secs()).expect("honest");

    let holders = ["a", "b"].map(|name| dir.path().join(name));
    for (holder, number) in holders.iter().zip(1..) {
        fs_err::create_dir(holder).expect("made");
        fs_err::copy(usb.join(format!("{number}.key")), holder.join("mine.key")).expect("copied");
    }
    let metadata = Metadata::open(&store).expect("opens");
    let nowhere = default_root_folder(&store);
    let stolen = metadata.keys_status(&usb).expect("a root").keys;
    let stolen = stolen.iter().find(|key| key.role == "timestamp").expect("there").id.clone();
    let changed = metadata.change_keys(&Change::Key(stolen.clone()), &nowhere, clock_unix_secs()).unwrap();
    let draft = changed.draft.expect("without a key it is a draft");
    // Meanwhile, the store goes on under the present root.
    metadata.refresh(clock_unix_secs(), 1).expect("signs");
    follow(&mut kept, &store, clock_unix_secs()).expect("nothing has changed");
    for holder in &holders {
        assert!(matches!(
            metadata.install_root(&draft, clock_unix_secs()),
            Err(StoreError::RootDraft { cause: TufError::Signatures { .. }, .. })
        ));
        // A second signature does not count.
        for _ in 0..2 {
            assert_eq!(sign_draft(&draft, holder).expect("signs"), 1);
        }
    }
    assert_eq!(metadata.install_root(&draft, clock_unix_secs()).expect("two of three").root_version, 2);
    assert!(!draft.exists());
    let keys = metadata.keys_status(&usb).expect("a root").keys;
    assert!(keys.iter().all(|key| key.id != stolen), "{keys:?}");
    follow(&mut kept, &store, clock_unix_secs()).expect("follows");
    assert!(matches!(
        metadata.change_keys(&Change::Key(stolen), &usb, clock_unix_secs()),
        Err(StoreError::Failed(_))
    ));
    assert_error(metadata.make_root(&usb, 1, 1, 0), &["has a root already"]);
}

/// A crash between root and keys: the named key is put in place when needed.
#[test]
fn a_key_that_a_crash_left_behind_is_put_in_place() {
    let dir = tempfile::tempdir().expect("temporary folder");
    publish(dir.path(), 1).expect("publishes");
    let mut kept = client(dir.path());
    let metadata = Metadata::open(dir.path()).expect("opens");
    let key = |name: &str| dir.path().join("keys").join(name);
    let old = fs_err::read(key("timestamp.key")).expect("there");
    metadata
        .change_keys(&roles(&["timestamp"]), &default_root_folder(dir.path()), clock_unix_secs())
        .expect("signs");
    fs_err::rename(key("timestamp.key"), key("timestamp.next.key")).expect("moved");
    fs_err::write(key("timestamp.key"), old).expect("written");
    metadata.refresh(clock_unix_secs(), 1).expect("signs with the new key");
    follow(&mut kept, dir.path(), clock_unix_secs()).expect("fresh");
}

/// A lost or damaged key of a role: the error names the command that helps, and robots follow it.
#[test]
fn a_lost_key_of_a_role_is_rotated() {
    for role in ["targets", "snapshot", "timestamp"] {
        for text in [None, Some(""), Some("0123")] {
            let dir = tempfile::tempdir().expect("temporary folder");
            publish(dir.path(), 1).expect("publishes");
            let mut kept = client(dir.path());
            follow(&mut kept, dir.path(), clock_unix_secs()).expect("honest");
            let path = dir.path().join("keys").join(format!("{role}.key"));
            match text {
                Some(text) => fs_err::write(&path, text).expect("written"),
                None => fs_err::remove_file(&path).expect("there"),
            }
            let store = Store::create_or_open(dir.path()).expect("what is published needs no key");
            let refused = store.publish(&manifest_of(2, &[]), &Extras::new()).expect_err("no key");
            assert!(matches!(refused, StoreError::Key { .. }), "{refused}");
            let text = refused.to_string();
            assert!(
                text.contains(&format!("slag-encoder keys rotate {role}")) && !text.contains("remove"),
                "{text}"
            );
            drop(store);
            let root_keys = default_root_folder(dir.path());
            let metadata = Metadata::open(dir.path()).expect("opens");
            metadata.change_keys(&roles(&[role]), &root_keys, clock_unix_secs()).expect("signs");
            drop(metadata);
            publish(dir.path(), 3).expect("publishes");
            follow(&mut kept, dir.path(), clock_unix_secs()).unwrap_or_else(|e| panic!("{role}: {e}"));
        }
    }
}

/// Only changes of keys need root's keys: a damaged one stops nothing else, and is named when needed.
#[test]
fn a_damaged_root_key_stops_changes_of_keys_alone() {
    let dir = tempfile::tempdir().expect("temporary folder");
    publish(dir.path(), 1).expect("publishes");
    let root_keys = default_root_folder(dir.path());
    fs_err::write(root_keys.join("1.key"), "damaged").expect("written");
    publish(dir.path(), 2).expect("publishes");
    let metadata = Metadata::open(dir.path()).expect("opens");
    metadata.refresh(clock_unix_secs(), 1).expect("signs");
    let status = metadata.keys_status(&root_keys).expect("a root");
    let root = status.keys.iter().find(|key| key.role == "root").expect("listed");
    assert!(!root.is_here && status.root_sha256 == metadata.root_sha256().expect("a root"));
    let refused = metadata.change_keys(&roles(&["timestamp"]), &root_keys, clock_unix_secs());
    assert_error(refused, &["1.key", "restore it from a backup"]);
}

/// Before there is a root, a damaged key may be made anew, and the error says so.
#[test]
fn a_damaged_key_that_no_root_names_is_made_anew() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let path = dir.path().join("keys/targets.key");
    fs_err::create_dir(dir.path().join("keys")).expect("made");
    fs_err::write(&path, "damaged").expect("written");
    let metadata = Metadata::open(dir.path()).expect("opens");
    let make = || metadata.make_root(&default_root_folder(dir.path()), 1, 1, clock_unix_secs());
    assert_error(make(), &["move it away, and a new key is made"]);
    fs_err::remove_file(path).expect("there");
    make().expect("makes");
}
