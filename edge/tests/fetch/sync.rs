//! Fetches without faults or with transient ones: downloads, kept and freed shards.

use super::*;

#[test]
fn the_second_fetch_brings_only_the_difference() {
    let first = Published::new(1, &[0; 8], 100);
    let (server, mut robot) = Robot::started(first.clone());
    assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));

    // x = 5, radius 20: cells 0 (0..10), 1, 2 (20..30, 15 away).
    let report = robot.fetch().expect("works");
    assert_eq!((report.n_cells, report.downloaded.n_shards, report.kept.n_shards), (3, 3, 0));
    assert_eq!(report.downloaded.bytes, first.bytes(0..3));
    let n_sent: usize = server.take_objects().iter().map(|seen| seen.body_bytes).sum();
    assert_eq!(n_sent as u64, first.bytes(0..3));
    assert!(report.is_first_contact && report.root_version == 1 && report.generation == 1);
    assert_holds(&robot.snapshot(), &first, 0..3);
    let stat = robot.cache.current_stat().expect("readable");

    // Nothing new: three small requests (is there another root, timestamp, targets), and nothing written. Source and
    // position are those of the last fetch.
    robot.request = FetchRequest { from: None, at: None, ..robot.request };
    let report = robot.fetch().expect("works");
    assert_eq!((report.downloaded.n_shards, report.kept.n_shards, report.freed.n_shards), (0, 3, 0));
    let seen = server.take_seen();
    assert_eq!(seen.iter().map(|seen| seen.status).collect::<Vec<_>>(), [404, 200, 200]);
    assert_eq!(robot.cache.current_stat().expect("readable"), stat);
    assert!(!report.is_first_contact);

    // A new generation changes cell 1, and the robot moves: cells 1..=3 (x = 25) are needed, cell 0 is not.
    let second = Published::new(2, &[0, 7, 0, 0, 0, 0, 0, 0], 100);
    server.publish(second.clone());
    robot.go(25.0, 14.0, &second, 1..4);
    let report = robot.fetch().expect("works");
    let objects = server.take_objects();
    let expected = [1, 3].map(|id| format!("/v1/objects/{}", second.hash(id, Profile::Compact)));
    assert_eq!(objects.iter().map(|seen| seen.path.as_str()).collect::<Vec<_>>(), expected);
    assert_eq!((report.kept.n_shards, report.freed.n_shards, report.spare.n_shards), (1, 2, 0));
    assert_holds(&robot.snapshot(), &second, 1..4);
    assert_eq!(robot.shards().len(), 3);
    assert_ne!(robot.cache.current_stat().expect("readable"), stat);
}

#[test]
fn the_least_recently_used_are_freed_first() {
    let scene = Published::new(1, &[0; 8], 100);
    let (_server, mut robot) = Robot::started(scene.clone());
    robot.request.radius = 2.0;
    robot.request.max_bytes = Some(scene.bytes(0..3));
    // Visits cells 0, 1, 0, 2: the next one evicts cell 1, not cell 0.
    for x in [5.0, 15.0, 5.0, 25.0, 35.0] {
        robot.request.at = Some(at(x));
        robot.fetch().expect("works");
    }
    let mut expected = [0, 2, 3].map(|id| scene.hash(id, Profile::Compact));
    expected.sort();
    assert_eq!(robot.shards(), expected);
    robot.request.max_bytes = Some(scene.bytes(0..1) - 1);
    let error = robot.fetch().expect_err("too large").to_string();
    assert!(error.starts_with("the 1 cells need "), "{error}");
    robot.request.at = Some(at(500.0));
    assert_error(robot.fetch(), &["the nearest is 420.0 away"]);
    assert_holds(&robot.snapshot(), &scene, 3..4);
}

#[test]
fn an_interrupted_download_goes_on_where_it_ended() {
    let scene = Published::new(1, &[0; 3], 2000);
    let (server, mut robot) = Robot::started(scene.clone());
    robot.request.radius = 2.0;
    robot.limits.attempts = 1;
    let len = scene.bytes(0..1) as usize;
    let cut = len * 2 / 3;
    server.fault_at("objects", Fault::Cut(cut));
    assert!(matches!(robot.fetch(), Err(FetchError::Download { .. })));
    assert_eq!(robot.staged().len(), 1);
    server.take_seen();

    server.faults(|_| Fault::None);
    // The request was recorded with the accepted manifest, so it need not be repeated.
    robot.request.from = None;
    let report = robot.fetch().expect("works");
    let objects = server.take_objects();
    assert_eq!(objects.len(), 1);
    assert_eq!(objects[0].status, 206);
    assert_eq!(objects[0].range_start, Some(cut));
    assert_eq!(objects[0].body_bytes, len - cut);
    assert_eq!(report.resumed_bytes, cut as u64);
    assert_holds(&robot.snapshot(), &scene, 0..1);
    assert!(robot.staged().is_empty());
}

/// One transient fault of each kind on every object, in one fetch: it succeeds, each retry resuming the last.
#[test]
fn passing_faults_are_overcome() {
    let faults = [
        (Fault::Cut(700), true),
        (Fault::Status(503), true),
        (Fault::Status(429), true),
        (Fault::Corrupt(100), false),
        (Fault::Length(-3), true),
        (Fault::Length(9), true),
        (Fault::Stall, true),
    ];
    for (fault, is_retry_cheap) in faults {
        let scene = Published::new(1, &[0; 3], 300);
        let (server, mut robot) = Robot::started(scene.clone());
        robot.limits.read_timeout = std::time::Duration::from_millis(400);
        let (mut seen_paths, fault_given) = (std::collections::BTreeSet::new(), fault.clone());
        server.faults(move |seen| {
            match seen_paths.insert(seen.path.clone()) && seen.path.contains("objects") {
                true => fault_given.clone(),
                false => Fault::None,
            }
        });
        assert_eq!(robot.fetch().unwrap_or_else(|e| panic!("{fault:?}: {e}")).retries, 3, "{fault:?}");
        assert_holds(&robot.snapshot(), &scene, 0..3);
        let second: usize = server.take_objects().iter().filter(|seen| seen.range_start.is_some()).count();
        assert!(is_retry_cheap || second == 0, "{fault:?}: damaged bytes are not resumed");
    }
}

/// The partial file has other content, or the server or a proxy ignores ranges or answers them wrongly, once or
/// always: then the part is dropped, and the whole file is requested.
#[test]
fn resuming_never_mixes_contents() {
    let once = [Fault::None, Fault::IgnoreRange, Fault::ShiftedRange(1), Fault::Status(416)];
    let refused = [304, 403, 500].map(Fault::Status).into_iter();
    let always = [Fault::ShiftedRange(1), Fault::Slice].into_iter().chain(refused);
    let faults = once.map(|fault| (fault, true)).into_iter();
    for (fault, is_once) in faults.chain(always.map(|fault| (fault, false))) {
        let scene = Published::new(1, &[0; 3], 300);
        let (server, mut robot) = Robot::started(scene.clone());
        robot.request.radius = 2.0;
        let hash = scene.hash(0, Profile::Compact);
        let staging = robot.cache.dir().join("staging");
        fs_err::create_dir_all(&staging).expect("made");
        let part = if is_once { &[b'x'; 700][..] } else { &scene.objects[&hash][..700] };
        fs_err::write(staging.join(format!("{hash}.part")), part).expect("written");
        fs_err::write(staging.join("orphan"), b"x").expect("written");
        let (mut is_first, given) = (true, fault.clone());
        server.faults(move |seen| match seen.range_start {
            Some(_) if !is_once || std::mem::take(&mut is_first) => given.clone(),
            _ => Fault::None,
        });
        let report = robot.fetch().unwrap_or_else(|e| panic!("{fault:?}: {e}"));
        assert!(is_once || report.retries <= 1, "{fault:?}");
        assert_holds(&robot.snapshot(), &scene, 0..1);
        assert!(robot.staged().is_empty());
    }
}

/// Static hosts answer 403 or 410 if there is no newer root.
#[test]
fn a_root_that_is_not_there_may_be_refused() {
    for status in [403, 404, 410] {
        let scene = Published::new(1, &[0; 1], 10);
        let (server, robot) = Robot::started(scene.clone());
        server.fault_at("/2.root.json", Fault::Status(status));
        robot.fetch().unwrap_or_else(|e| panic!("{status}: {e}"));
        assert!(server.take_seen().iter().any(|seen| seen.path.ends_with("/2.root.json")));
        assert_holds(&robot.snapshot(), &scene, 0..1);
    }
}

struct CancelAt<'a> {
    cancel: &'a AtomicBool,
    bytes: u64,
    received: AtomicU64,
}

impl Progress for CancelAt<'_> {
    fn received(&self, bytes: u64) {
        if self.received.fetch_add(bytes, Ordering::Relaxed) + bytes >= self.bytes {
            self.cancel.store(true, Ordering::Relaxed);
        }
    }
}

#[test]
fn cancelling_ends_soon_and_loses_nothing() {
    let scene = Published::new(1, &[0; 3], 5000);
    let (_server, robot) = Robot::started(scene.clone());
    let cancel = AtomicBool::new(false);
    let progress = CancelAt { cancel: &cancel, bytes: 10_000, received: AtomicU64::new(0) };
    assert!(matches!(robot.fetch_watched(&progress, &cancel), Err(FetchError::Cancelled)));
    // At most one buffer arrives after the flag is set.
    assert!(progress.received.load(Ordering::Relaxed) <= 10_000 + 512);
    assert!(matches!(Snapshot::open(&robot.cache), Err(StoreError::Empty { .. })));
    let report = robot.fetch().expect("works");
    assert!(report.resumed_bytes >= 9_000, "{report:?}");
    assert_holds(&robot.snapshot(), &scene, 0..3);
}

#[test]
fn one_fetch_at_a_time() {
    let (_server, robot) = Robot::fetched(Published::new(1, &[0; 3], 10));
    let records = Records::open(&robot.cache).expect("free");
    assert!(matches!(robot.fetch(), Err(FetchError::Records(RecordsError::Busy { .. }))));
    robot.snapshot();
    drop(records);
    robot.fetch().expect("free again");
}

/// A shard of another cell or encoder under the right name is refused on opening.
#[test]
fn a_shard_that_the_manifest_does_not_describe_is_refused() {
    // Alone, so that nothing else answers.
    let scene = Published::new(1, &[0], 100);
    let (_server, robot) = Robot::started(scene.clone());
    for (cell_id, encoder, expected) in
        [(1, ENCODER, "the cell is 1, the manifest says 0"), (0, Hash32([8; 32]), "the encoder is 0808")]
    {
        assert_eq!(robot.fetch().expect("heals").encoder_id, ENCODER);
        let path = robot.cache.shard_path(scene.hash(0, Profile::Compact));
        let spec =
            super::scene::ShardSpec { cell_id, content: 0, n_gaussians: 100, encoder, is_exact: false };
        fs_err::write(&path, super::scene::shard(&spec)).expect("written");
        assert_error(Snapshot::open(&robot.cache), &[expected]);
    }
}

/// Readers that reopen snapshots during fetches always get a whole one.
#[test]
fn readers_get_a_whole_generation_during_fetches() {
    let scene = Published::new(1, &[0; 8], 50);
    let (_server, mut robot) = Robot::started(scene.clone());
    robot.request.radius = 2.0;
    robot.request.max_bytes = Some(scene.bytes(0..1));
    robot.fetch().expect("works");
    let (is_over, seen) = (AtomicBool::new(false), Mutex::new(std::collections::BTreeSet::new()));
    let reader = EdgeCache::open(robot.cache.dir());
    std::thread::scope(|scope| {
        let readers: Vec<_> = (0..2)
            .map(|_| {
                scope.spawn(|| {
                    while !is_over.load(Ordering::Relaxed) {
                        let snapshot = Snapshot::open(&reader).expect("a whole generation");
                        let cell_id = snapshot.shards[0].cell.cell_id;
                        assert_holds(&snapshot, &scene, cell_id..cell_id + 1);
                        seen.lock().expect("sound").insert(cell_id);
                    }
                })
            })
            .collect();
        for step in 0..40 {
            robot.request.at = Some(at(f64::from(step % 8) * 10.0 + 5.0));
            robot.fetch().expect("works");
        }
        is_over.store(true, Ordering::Relaxed);
        readers.into_iter().for_each(|reader| reader.join().expect("no reader failed"));
    });
    assert!(seen.lock().expect("sound").len() > 1);
}

/// `Retry-After` is honoured up to a limit, in addition to the backoff.
#[test]
fn retry_after_is_honoured_within_bounds() {
    let scene = Published::new(1, &[0; 1], 10);
    // Requested in seconds, limited in milliseconds; expected is the range of the time waited.
    for (fault, allowed_ms, expected_ms) in [
        (Fault::RetryAfter(503, 3600), 120, 120..60_000),
        (Fault::RetryAfter(429, 3600), 120, 120..60_000),
        (Fault::RetryAfter(503, 1), 60_000, 1000..60_000),
        (Fault::RetryAfter(500, 3600), 3_600_000, 0..60_000),
        (Fault::RetryAfter(503, u64::MAX), 1, 1..60_000),
    ] {
        let (server, mut robot) = Robot::started(scene.clone());
        robot.limits.longest_retry_after = std::time::Duration::from_millis(allowed_ms);
        let (mut is_first, given) = (true, fault.clone());
        server.faults(move |_| if std::mem::take(&mut is_first) { given.clone() } else { Fault::None });
        let start = std::time::Instant::now();
        assert_eq!(robot.fetch().expect("works").retries, 1, "{fault:?}");
        assert!(expected_ms.contains(&start.elapsed().as_millis()), "{fault:?}: {:?}", start.elapsed());
    }
}
