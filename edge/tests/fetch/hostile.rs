//! Attacks and faults of a server that must have no effect.

use super::*;

use slag_common::manifest::ManifestError;

use super::scene::{ShardSpec, shard};

#[derive(Default)]
struct Count(AtomicU64);

impl Progress for Count {
    fn received(&self, bytes: u64) {
        self.0.fetch_add(bytes, Ordering::Relaxed);
    }
}

/// An intact shard of the right cell and length under another shard's hash: only the hash reveals it.
#[test]
fn other_content_under_a_hash_is_refused() {
    let (scene, other) = (Published::new(1, &[0; 1], 50), Published::new(1, &[1; 1], 50));
    let (server, robot) = Robot::started(scene.clone());
    let instead = other.objects[&other.hash(0, Profile::Compact)].clone();
    assert_eq!(instead.len() as u64, scene.bytes(0..1));
    server.fault_at("objects", Fault::Instead(instead));
    let error = robot.fetch().expect_err("refused");
    assert!(matches!(error, FetchError::Download { failure: DownloadFailure::Hash { .. }, .. }), "{error}");
    assert!(robot.shards().is_empty() && robot.staged().is_empty());
    assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));
    server.faults(|_| Fault::None);
    robot.fetch().expect("works");
}

#[test]
fn endless_bodies_are_cut_off() {
    let scene = Published::new(1, &[0; 1], 50);
    let (server, mut robot) = Robot::started(scene.clone());
    // The right content, followed by more: only the manifest's length is read.
    server.fault_at("objects", Fault::Endless);
    let count = Count::default();
    robot.fetch_watched(&count, &AtomicBool::new(false)).expect("the content is right");
    assert_eq!(count.0.load(Ordering::Relaxed), scene.bytes(0..1));
    robot.limits.chunk_bytes = 1 << 16;
    server.publish(Published::new(2, &[0; 1], 50));
    for (part, expected) in [("", "timestamp.json"), ("/targets/", "manifest")] {
        // An announced length above the limit fails at once.
        for fault in [Fault::Endless, Fault::Length(1 << 30)] {
            server.fault_at(part, fault);
            let error = robot.fetch().expect_err("refused");
            let is_expected =
                matches!(&error, FetchError::Tuf(TufError::TooLong { what, .. }) if what.ends_with(expected));
            assert!(is_expected, "{expected}: {error}");
            assert_holds(&robot.snapshot(), &scene, 0..1);
        }
    }
}

#[test]
fn redirects_are_refused() {
    let scene = Published::new(1, &[0; 1], 50);
    let (server, elsewhere) = (Server::start(scene.clone()), Server::start(scene));
    for part in ["timestamp", "/targets/", "objects"] {
        let robot = Robot::of(&server);
        let location = elsewhere.url();
        server.faults(move |seen| match seen.path.contains(part) {
            true => Fault::Redirect(format!("{location}{}", seen.path)),
            false => Fault::None,
        });
        assert_error(robot.fetch(), &[&elsewhere.url()]);
    }
    assert!(elsewhere.take_seen().is_empty());
}

#[test]
fn lasting_faults_are_given_up_and_told() {
    let scene = Published::new(1, &[0; 1], 2000);
    let len = scene.bytes(0..1);
    type Check = fn(&DownloadFailure) -> bool;
    let cases: [(Fault, u32, Check); 6] = [
        (Fault::Status(404), 1, |f| matches!(f, DownloadFailure::Status { status: 404, .. })),
        (Fault::Status(500), 3, |f| matches!(f, DownloadFailure::Status { status: 500, .. })),
        (Fault::Length(1), 3, |f| matches!(f, DownloadFailure::Length { .. })),
        (Fault::Corrupt(900), 3, |f| matches!(f, DownloadFailure::Hash { .. })),
        (Fault::Cut(0), 3, |f| matches!(f, DownloadFailure::Transport(_) | DownloadFailure::Cut { .. })),
        // Progress each time, but too little to count.
        (Fault::Cut(100), 3, |f| matches!(f, DownloadFailure::Transport(_) | DownloadFailure::Cut { .. })),
    ];
    for (fault, expected_attempts, is_expected) in cases {
        let (server, robot) = Robot::started(scene.clone());
        server.fault_at("objects", fault.clone());
        let count = Count::default();
        let error = robot.fetch_watched(&count, &AtomicBool::new(false)).expect_err("lasting");
        // Invalid bytes are dropped.
        assert_eq!(error.to_string().contains("are kept"), fault == Fault::Cut(100), "{fault:?}: {error}");
        match error {
            FetchError::Download { attempts, failure, .. } => {
                let holds = attempts == expected_attempts && is_expected(&failure);
                assert!(holds, "{fault:?}: {attempts} {failure}");
            }
            other => panic!("{fault:?}: {other}"),
        }
        assert_eq!(server.take_objects().len() as u32, expected_attempts, "{fault:?}");
        assert!(count.0.load(Ordering::Relaxed) <= 3 * len, "{fault:?}");
    }
}

/// A signed manifest may be wrong, too: nothing of it reaches `current`.
#[test]
fn signed_nonsense_is_refused() {
    let scene = Published::new(1, &[0; 2], 50);
    let fetched = |published: Published| {
        let (_server, robot) = Robot::started(published);
        let error = robot.fetch().expect_err("refused");
        assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));
        error
    };
    // One bad cell; the other is good.
    let without_a_cell = |published: Published, bad_id: u32| {
        let (_server, robot) = Robot::started(published);
        let bad = BadCell { cell_id: bad_id, fault: CellFault::Invalid, old: None };
        assert_eq!(robot.fetch().expect("the other cell").bad_cells, [bad]);
        assert_eq!(cells(&robot.snapshot()), [1 - bad_id]);
    };
    without_a_cell(scene.clone().edited(|manifest| manifest.cells[1].n_gaussians = 51), 1);
    let error = fetched(scene.clone().edited(|manifest| manifest.encoder.id = Hash32([5; 32])));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(|manifest| manifest.encoder.dim = 5));
    assert!(matches!(error, FetchError::Published { .. }), "{error}");
    let error = fetched(scene.clone().edited(|manifest| {
        manifest.cells[1].shards = manifest.cells[0].shards.clone();
    }));
    assert!(error.to_string().contains("and for another cell"), "{error}");

    // An object that is not a shard; an empty one; one longer than any disk.
    let listing = |mut published: Published, bytes: &[u8], len_bytes: u64| {
        let hash = Hash32::of(bytes);
        published.objects.insert(hash, bytes.to_vec());
        published.edited(|manifest| {
            let record = manifest.cells[0].shards.get_mut(&Profile::Compact).expect("there");
            (record.hash, record.len_bytes) = (hash, len_bytes);
        })
    };
    without_a_cell(listing(scene.clone(), b"junk", 4), 0);
    without_a_cell(listing(scene.clone(), b"", 0), 0);
    let error = fetched(listing(scene.clone(), b"long", u64::MAX));
    assert!(matches!(error, FetchError::NoSpace { needed_bytes: u64::MAX, .. }), "{error}");

    // Kept shards are checked against the new manifest too.
    let (server, robot) = Robot::fetched(scene.clone());
    server.publish(scene.clone().edited(|manifest| {
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
    let none =
        " store /etc/passwd file:///etc/passwd ftp://host http:// http://a@b http://a/?q=1 http://a/#f";
    for from in none.split(' ') {
        assert_error(Robot::on_disk(dir.path(), from).fetch(), &["is not the address of a store"]);
    }
    let mut robot = Robot::on_disk(dir.path(), "http://a");
    robot.request.from = None;
    assert_error(robot.fetch(), &["--from URL"]);
    robot.request = FetchRequest { from: Some("http://a".into()), at: None, ..robot.request };
    assert_error(robot.fetch(), &["--at X,Y,Z", "--at-geo"]);
}

/// Names become paths: only 64 hex digits are accepted.
#[test]
fn names_that_are_paths_are_refused() {
    let scene = Published::new(1, &[0; 1], 50);
    let json = String::from_utf8(scene.listed.clone()).expect("JSON");
    let name = scene.hash(0, Profile::Compact).to_string();
    let upper = name.to_uppercase();
    for path in ["../../../etc/passwd", "/etc/passwd", "", ".", "..\\\\x", "a/b", &name[1..], &upper] {
        let mut hostile = scene.clone();
        hostile.listed = json.replace(&name, path).into_bytes();
        let hostile = hostile.signed_by(&[FIRST], 1);
        let (server, robot) = Robot::started(hostile);
        let error = robot.fetch().expect_err("refused");
        assert!(matches!(error, FetchError::Manifest(ManifestError::Content { .. })), "{path}: {error}");

        server.publish(scene.clone().signed_by(&[FIRST], 2));
        robot.fetch().expect("works");
        let current = fs_err::read_to_string(robot.cache.current_path()).expect("there");
        fs_err::write(robot.cache.current_path(), current.replace(&name, path)).expect("written");
        let error = Snapshot::open(&robot.cache).expect_err("refused");
        assert!(matches!(error, StoreError::Current { .. }), "{path}: {error}");
    }
}
