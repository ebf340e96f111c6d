//! What clients of The Update Framework see of a store; the oracle is the client of `slag-common`.

use std::path::Path;

use slag_common::manifest::{self, Manifest};
use slag_common::tuf::{Kept, Source, Trusted, TufError, refresh};

use super::ceremony::{Change, default_root_folder};
use super::metadata::{
    Metadata, MetadataReader, RELEASE_UNIX_SECS, clock_unix_secs, read_published, signing_time,
};
use super::tests::{manifest as manifest_of, new_store};
use super::{Extras, Store, StoreError};

const DAY: u64 = 86_400;
/// Later than the clock, in the year 2079.
const NOW: u64 = 40_000 * DAY;

struct Folder<'a>(&'a Path);

impl Source for Folder<'_> {
    fn metadata(&mut self, name: &str, _: u64) -> Result<Option<Vec<u8>>, String> {
        read_published(self.0, name).map_err(|e| e.to_string())
    }
}

fn published(now: u64) -> (tempfile::TempDir, Store) {
    let (dir, store) = new_store();
    publish(&store, 1, now);
    (dir, store)
}

fn publish(store: &Store, generation: u64, now: u64) {
    let scene = Manifest { created_unix_secs: now, ..manifest_of(generation, &[]) };
    store.publish(&scene, &Extras::new()).expect("publishes");
}

pub(super) fn client(dir: &Path) -> Kept {
    Kept::from_root(&read_published(dir, "1.root.json").expect("readable").expect("there")).expect("a root")
}

/// A generation of an empty scene, dated 1970.
pub(super) fn publish_in(dir: &Path, generation: u64) -> Result<(), StoreError> {
    Store::create_or_open(dir)?.publish(&manifest_of(generation, &[]), &Extras::new()).map(drop)
}

pub(super) fn follow(kept: &mut Kept, dir: &Path, now: u64) -> Result<Trusted, TufError> {
    let trusted = refresh(kept, &mut Folder(dir), now)?;
    let bytes = fs_err::read(dir.join("manifest")).expect("there");
    trusted.target(manifest::TARGET).expect("listed").check(manifest::TARGET, &bytes)?;
    Ok(trusted)
}

#[test]
fn each_generation_is_a_target() {
    let (dir, store) = published(NOW);
    let mut kept = client(dir.path());
    for generation in 2..5 {
        publish(&store, generation, NOW + generation);
        let trusted = follow(&mut kept, dir.path(), NOW).expect("honest");
        assert_eq!(trusted.timestamp().map(|t| t.head.version), Some(generation));
        assert_eq!(trusted.now_unix_secs(), NOW + generation, "the signed time is later than the clock");
    }
    // Publishing the same again signs nothing.
    let before = fs_err::read(dir.path().join("metadata/timestamp.json")).expect("there");
    publish(&store, 4, NOW + 4);
    assert_eq!(fs_err::read(dir.path().join("metadata/timestamp.json")).expect("there"), before);
}

/// A crash after replacing the manifest leaves clients with the previous generation; opening repairs it.
#[test]
fn metadata_behind_the_manifest_is_made_good() {
    let (dir, store) = published(NOW);
    let timestamp = dir.path().join("metadata/timestamp.json");
    let old = fs_err::read(&timestamp).expect("there");
    publish(&store, 2, NOW);
    fs_err::write(&timestamp, old).expect("written");
    drop(store);
    Store::create_or_open(dir.path()).expect("opens");
    follow(&mut client(dir.path()), dir.path(), NOW).expect("generation 2");
}

#[test]
fn a_refresh_keeps_clients_and_needs_no_root_key() {
    let dir = tempfile::tempdir().expect("temporary folder");
    assert!(matches!(
        Metadata::open(dir.path()).and_then(|metadata| metadata.refresh(NOW, 1)),
        Err(StoreError::NotPublished { .. })
    ));
    publish(&Store::create_or_open(dir.path()).expect("opens"), 1, NOW);
    let mut kept = client(dir.path());
    fs_err::remove_dir_all(dir.path().join("keys/root")).expect("there");
    let later = NOW + 31 * DAY;
    assert!(matches!(follow(&mut kept, dir.path(), later), Err(TufError::Expired { .. })));
    // While a writer is open.
    let refreshed = Metadata::open(dir.path()).expect("opens").refresh(later, 1).expect("signs");
    assert_eq!((refreshed.timestamp_version, refreshed.snapshot_version), (2, 1));
    assert_eq!(refreshed.expires_unix_secs, later + DAY);
    follow(&mut kept, dir.path(), later).expect("fresh");
    // Long after: snapshot and targets are signed anew too.
    let later = NOW + 400 * DAY;
    let refreshed = Metadata::open(dir.path()).expect("opens").refresh(later, 1).expect("signs");
    assert_eq!(refreshed.snapshot_version, 2);
    follow(&mut kept, dir.path(), later).expect("fresh");
}

/// A root made while the clock stood at 1970 has expired for every robot: a refresh does not help, a renewal does, and
/// the warnings say so. A root with years to go causes no warning.
#[test]
fn an_expired_root_is_warned_of_and_renewed() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let metadata = Metadata::open(dir.path()).expect("opens");
    metadata.make_root(&default_root_folder(dir.path()), 1, 1, 0).expect("makes");
    drop(metadata);
    publish(&Store::create_or_open(dir.path()).expect("opens"), 1, NOW);
    let mut kept = client(dir.path());
    let is_refused = |kept: &mut Kept| matches!(follow(kept, dir.path(), NOW), Err(TufError::Expired { .. }));
    assert!(is_refused(&mut kept));
    let warned = || MetadataReader::new(dir.path()).expiry_warnings(NOW).expect("reads");
    let [warning] = &warned()[..] else { panic!("{:?}", warned()) };
    let holds = warning.contains("root metadata expired at 1974-12-31") && warning.contains("keys renew");
    assert!(holds, "{warning}");
    let metadata = Metadata::open(dir.path()).expect("opens");
    metadata.refresh(NOW, 30).expect("signs");
    assert!(is_refused(&mut kept), "a refresh does not help");
    let renewal = Change::Roles(Vec::new());
    let renewed = metadata.change_keys(&renewal, &default_root_folder(dir.path()), NOW).expect("renews");
    assert_eq!((renewed.root_version, renewed.draft), (2, None));
    follow(&mut kept, dir.path(), NOW).expect("the same client follows");
    assert_eq!(warned(), [""; 0]);
    // Half a year before its end.
    let later = NOW + (5 * 365 - 180) * DAY;
    metadata.refresh(later, 30).expect("signs");
    let warnings = MetadataReader::new(dir.path()).expiry_warnings(later).expect("reads");
    assert!(warnings.len() == 1 && warnings[0].contains("root metadata expires at"), "{warnings:?}");
    // A clock that stands at 1970 now.
    let warnings = MetadataReader::new(dir.path()).expiry_warnings(5).expect("reads");
    assert!(warnings.len() == 1 && warnings[0].contains("set the clock"), "{warnings:?}");
}

/// A store made while its clock stood in 2079: robots that saw it believe that time, so later signatures use it, until
/// a new timestamp key makes robots forget it; warnings say so.
#[test]
fn a_clock_that_went_back_locks_no_robot_out() {
    let (dir, _store) = published(NOW);
    let mut kept = client(dir.path());
    follow(&mut kept, dir.path(), NOW).expect("fresh");
    let now = NOW - 3650 * DAY;
    let metadata = Metadata::open(dir.path()).expect("opens");
    assert_eq!(metadata.refresh(now, 30).expect("signs").expires_unix_secs, NOW + 30 * DAY);
    follow(&mut kept, dir.path(), now).expect("no robot is locked out");
    let warnings = MetadataReader::new(dir.path()).expiry_warnings(now).expect("reads");
    assert!(warnings.len() == 1 && warnings[0].contains("keys rotate"), "{warnings:?}");
    let rotate = Change::Roles(vec!["timestamp".to_owned()]);
    metadata.change_keys(&rotate, &default_root_folder(dir.path()), now).expect("rotates");
    let trusted = follow(&mut kept, dir.path(), now).expect("follows");
    assert_eq!(trusted.now_unix_secs(), now, "the later time is forgotten");
    assert_eq!(MetadataReader::new(dir.path()).expiry_warnings(now).expect("reads"), [""; 0]);
}

/// A machine whose clock stands at 1970 signs nothing that has expired already.
#[test]
fn nothing_is_signed_as_of_1970() {
    assert_eq!(RELEASE_UNIX_SECS, 20_454 * DAY, "2026-01-01");
    assert_eq!([signing_time(5), signing_time(NOW)], [RELEASE_UNIX_SECS, NOW]);
}

/// Its signature would lock every client out.
#[test]
fn a_key_that_the_root_does_not_name_signs_nothing() {
    let (dir, _store) = published(NOW);
    fs_err::write(dir.path().join("keys/timestamp.key"), "07".repeat(32)).expect("written");
    let refused = Metadata::open(dir.path()).expect("opens").refresh(NOW, 1);
    let holds = matches!(refused, Err(StoreError::RoleKey { ref role, .. }) if role == "timestamp");
    assert!(holds, "{refused:?}");
}

#[test]
fn role_keys_are_private() {
    use std::os::unix::fs::PermissionsExt;
    let (dir, _store) = published(NOW);
    for name in ["root/1", "targets", "snapshot", "timestamp"] {
        let path = dir.path().join("keys").join(format!("{name}.key"));
        assert_eq!(fs_err::metadata(path).expect("there").permissions().mode() & 0o777, 0o600, "{name}");
    }
}

#[test]
fn only_names_of_metadata_are_read() {
    let (dir, _store) = published(NOW);
    fs_err::copy(dir.path().join("metadata/1.root.json"), dir.path().join("metadata/01.root.json"))
        .expect("copied");
    for name in ["01.root.json", "+1.root.json", "root.json", "lock", "../manifest", "1.timestamp.json", ""] {
        assert_eq!(read_published(dir.path(), name).expect("readable"), None, "{name}");
    }
}

/// A reproducible encode dates its manifest back; the timestamp must still be valid.
#[test]
fn a_manifest_that_is_dated_back_is_signed_today() {
    let (dir, _store) = published(1);
    follow(&mut client(dir.path()), dir.path(), clock_unix_secs()).expect("fresh");
}
