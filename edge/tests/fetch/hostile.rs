//! What a hostile or broken server cannot do.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use slag_common::Hash32;
use slag_common::manifest::{MAX_BYTES, ManifestError};
use slag_common::shard::Profile;
use slag_edge::fetch::{Failure, FetchError, PlanError, Progress};
use slag_edge::store::{Snapshot, StoreError};

use super::scene::{ENCODER, NOW, Published, ShardSpec, key, public, shard};
use super::server::{Fault, Seen, Server};
use super::{Robot, assert_holds};

fn objects(fault: Fault) -> impl FnMut(&Seen) -> Fault + Send + 'static {
    move |seen| if seen.path.contains("objects") { fault.clone() } else { Fault::None }
}

#[derive(Default)]
struct Count(AtomicU64);

impl Progress for Count {
    fn received(&self, bytes: u64) {
        self.0.fetch_add(bytes, Ordering::Relaxed);
    }
}

/// After each refusal the generation before it still answers.
#[test]
fn refused_manifests_leave_the_old_generation() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let second = Published::new(2, &[0; 4], 50);
    let server = Server::start(second.clone());
    let mut robot = Robot::on_disk(dir.path(), &server.url());
    robot.fetch().expect("works");
    let third = Published::new(3, &[1; 4], 50);
    let refused = |robot: &Robot, published: Published| {
        server.publish(published);
        let error = robot.fetch().expect_err("refused");
        assert_holds(&robot.snapshot(), &second, 0..3);
        error
    };

    let foreign = third.clone().edited(&key(2), |_| {});
    let error = refused(&robot, foreign.clone());
    assert!(matches!(error, FetchError::Manifest(ManifestError::UnknownKey { .. })), "{error}");
    let mut forged = third.clone();
    *forged.signed.last_mut().expect("not empty") ^= 1;
    let error = refused(&robot, forged);
    assert!(matches!(error, FetchError::Manifest(ManifestError::Signature)), "{error}");
    let expired = third.clone().edited(&key(1), |manifest| manifest.expires_unix_secs = Some(NOW - 1));
    let error = refused(&robot, expired);
    assert!(matches!(error, FetchError::Manifest(ManifestError::Expired { .. })), "{error}");
    let replayed = Published::new(1, &[0; 4], 50);
    let error = refused(&robot, replayed.clone());
    assert!(matches!(error, FetchError::Rollback { seen: 2, offered: 1, .. }), "{error}");
    robot.request.expected_encoder = Some(Hash32([3; 32]));
    let error = refused(&robot, third.clone());
    assert!(matches!(error, FetchError::Encoder { found: ENCODER, .. }), "{error}");
    robot.request.expected_encoder = Some(ENCODER);

    // Losing the records loses neither the key nor the generation.
    fs_err::remove_dir_all(robot.cache.dir().join("db")).expect("there");
    assert!(matches!(refused(&robot, replayed), FetchError::Rollback { seen: 2, .. }));
    assert!(matches!(
        refused(&robot, foreign.clone()),
        FetchError::Manifest(ManifestError::UnknownKey { .. })
    ));

    // A generation that was seen but never arrived counts: the one before it is a replay now.
    server.faults(objects(Fault::Status(404)));
    assert!(matches!(refused(&robot, third.clone()), FetchError::Download { .. }));
    server.faults(|_| Fault::None);
    assert!(matches!(refused(&robot, second.clone()), FetchError::Rollback { seen: 3, offered: 2, .. }));

    // The key is changed only when that is said; then the old one is no longer accepted.
    server.publish(foreign.clone());
    robot.request.key = Some(public(&key(2)));
    assert_eq!(robot.fetch().expect("accepted").key, public(&key(2)));
    assert_holds(&robot.snapshot(), &foreign, 0..3);
    robot.request.key = None;
    server.publish(Published::new(9, &[0; 4], 50));
    assert!(matches!(robot.fetch(), Err(FetchError::Manifest(ManifestError::UnknownKey { .. }))));
}

/// A sound shard of the right cell and length under another's hash: only the hash tells.
#[test]
fn other_content_under_a_hash_is_refused() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let (scene, other) = (Published::new(1, &[0; 1], 50), Published::new(1, &[1; 1], 50));
    let server = Server::start(scene.clone());
    let robot = Robot::on_disk(dir.path(), &server.url());
    let instead = other.objects[&other.hash(0, Profile::Compact)].clone();
    assert_eq!(instead.len() as u64, scene.bytes(0..1));
    server.faults(objects(Fault::Instead(instead)));
    let error = robot.fetch().expect_err("refused");
    assert!(matches!(error, FetchError::Download { failure: Failure::Hash { .. }, .. }), "{error}");
    assert!(robot.shards().is_empty() && robot.staged().is_empty());
    assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));
    server.faults(|_| Fault::None);
    robot.fetch().expect("works");
}

#[test]
fn endless_bodies_are_cut_off() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let scene = Published::new(1, &[0; 1], 50);
    let server = Server::start(scene.clone());
    let mut robot = Robot::on_disk(dir.path(), &server.url());
    // The right content, and then more: as many bytes as the manifest says are read.
    server.faults(objects(Fault::Endless));
    let count = Count::default();
    robot.fetch_watched(&count, &AtomicBool::new(false)).expect("the content is right");
    assert_eq!(count.0.load(Ordering::Relaxed), scene.bytes(0..1));
    robot.limits.chunk_bytes = 1 << 16;
    server.publish(Published::new(2, &[0; 1], 50));
    server.faults(|_| Fault::Endless);
    let error = robot.fetch().expect_err("refused");
    let limit = MAX_BYTES + 1;
    assert!(
        matches!(error, FetchError::Manifest(ManifestError::TooLong { len_bytes }) if len_bytes == limit),
        "{error}"
    );
    assert_holds(&robot.snapshot(), &scene, 0..1);
}

/// Neither the manifest nor an object is followed to another server.
#[test]
fn redirects_are_refused() {
    let scene = Published::new(1, &[0; 1], 50);
    let (server, elsewhere) = (Server::start(scene.clone()), Server::start(scene));
    for part in ["manifest", "objects"] {
        let dir = tempfile::tempdir().expect("temporary folder");
        let robot = Robot::on_disk(dir.path(), &server.url());
        let location = elsewhere.url();
        server.faults(move |seen| match seen.path.contains(part) {
            true => Fault::Redirect(format!("{location}{}", seen.path)),
            false => Fault::None,
        });
        let error = robot.fetch().expect_err("refused").to_string();
        assert!(error.contains(&elsewhere.url()), "{error}");
    }
    assert!(elsewhere.take_seen().is_empty());
}

#[test]
fn lasting_faults_are_given_up_and_told() {
    let scene = Published::new(1, &[0; 1], 2000);
    let len = scene.bytes(0..1);
    type Check = fn(&Failure) -> bool;
    let cases: [(Fault, u32, Check); 6] = [
        (Fault::Status(404), 1, |f| matches!(f, Failure::Status { status: 404 })),
        (Fault::Status(500), 3, |f| matches!(f, Failure::Status { status: 500 })),
        (Fault::Length(1), 3, |f| matches!(f, Failure::Length { .. })),
        (Fault::Corrupt(900), 3, |f| matches!(f, Failure::Hash { .. })),
        (Fault::Cut(0), 3, |f| matches!(f, Failure::Transport(_) | Failure::Cut { .. })),
        // A little progress each time, less than counts.
        (Fault::Cut(100), 3, |f| matches!(f, Failure::Transport(_) | Failure::Cut { .. })),
    ];
    for (fault, expected_attempts, is_expected) in cases {
        let dir = tempfile::tempdir().expect("temporary folder");
        let server = Server::start(scene.clone());
        let robot = Robot::on_disk(dir.path(), &server.url());
        server.faults(objects(fault.clone()));
        let count = Count::default();
        match robot.fetch_watched(&count, &AtomicBool::new(false)).expect_err("lasting") {
            FetchError::Download { attempts, failure, .. } => {
                assert!(
                    attempts == expected_attempts && is_expected(&failure),
                    "{fault:?}: {attempts} {failure}"
                );
            }
            other => panic!("{fault:?}: {other}"),
        }
        assert_eq!(server.take_objects().len() as u32, expected_attempts, "{fault:?}");
        assert!(count.0.load(Ordering::Relaxed) <= 3 * len, "{fault:?}");
    }
}

/// A signed manifest may be wrong as well: nothing of it gets behind `current`.
#[test]
fn signed_nonsense_is_refused() {
    let scene = Published::new(1, &[0; 2], 50);
    let fetched = |published: Published| {
        let dir = tempfile::tempdir().expect("temporary folder");
        let server = Server::start(published);
        let robot = Robot::on_disk(dir.path(), &server.url());
        let error = robot.fetch().expect_err("refused");
        assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));
        error
    };
    let error = fetched(scene.clone().edited(&key(1), |manifest| manifest.cells[1].n_gaussians = 51));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(&key(1), |manifest| manifest.encoder.id = Hash32([5; 32])));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(&key(1), |manifest| manifest.encoder.dim = 5));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(&key(1), |manifest| {
        manifest.cells[1].shards = manifest.cells[0].shards.clone();
    }));
    assert!(matches!(error, FetchError::Plan(PlanError::Conflict { .. })), "{error}");

    // A shard that is no shard; one of no bytes; one longer than any disk.
    let mut junk = scene.clone();
    let hash = Hash32::of(b"junk");
    junk.objects.insert(hash, b"junk".to_vec());
    let error = fetched(junk.edited(&key(1), |manifest| {
        let record = manifest.cells[0].shards.get_mut(&Profile::Compact).expect("there");
        (record.hash, record.len_bytes) = (hash, 4);
    }));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(&key(1), |manifest| {
        let record = manifest.cells[0].shards.get_mut(&Profile::Compact).expect("there");
        (record.hash, record.len_bytes) = (Hash32::of(b""), 0);
    }));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(&key(1), |manifest| {
        manifest.cells[0].shards.get_mut(&Profile::Compact).expect("there").len_bytes = u64::MAX;
    }));
    assert!(matches!(error, FetchError::Download { failure: Failure::Length { .. }, .. }), "{error}");

    // Kept shards are held against the new manifest too.
    let dir = tempfile::tempdir().expect("temporary folder");
    let server = Server::start(scene.clone());
    let robot = Robot::on_disk(dir.path(), &server.url());
    robot.fetch().expect("works");
    server.publish(scene.clone().edited(&key(1), |manifest| {
        (manifest.generation, manifest.encoder.id) = (2, Hash32([5; 32]));
    }));
    assert!(matches!(robot.fetch(), Err(FetchError::Published { .. })));
    assert_holds(&robot.snapshot(), &scene, 0..2);
    let spec = ShardSpec { cell_id: 0, content: 0, n_gaussians: 50, encoder: ENCODER, is_exact: false };
    assert_eq!(Hash32::of(&shard(&spec)), scene.hash(0, Profile::Compact));
}

#[test]
fn addresses_that_are_none_are_refused() {
    let dir = tempfile::tempdir().expect("temporary folder");
    for from in [
        "",
        "store",
        "/etc/passwd",
        "file:///etc/passwd",
        "ftp://host",
        "http://",
        "http://a@b",
        "http://a/?q=1",
        "http://a/#f",
    ] {
        let error = Robot::on_disk(dir.path(), from).fetch().expect_err("refused");
        assert!(matches!(error, FetchError::Address { .. }), "{from}: {error}");
    }
    let mut robot = Robot::on_disk(dir.path(), "http://a");
    robot.request.from = None;
    assert!(matches!(robot.fetch(), Err(FetchError::NotGiven { what: "store's address" })));
}
