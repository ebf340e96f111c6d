//! A shard that rots on board costs its cell only, is named, and is fetched again.

use super::*;
use std::sync::mpsc;

use slag_edge::fetch::follow::follow;
use slag_edge::http::{App, Settings, keep_scrubbing};

use super::partial::answering;

const UNREADABLE: BadCell = BadCell { cell_id: 1, fault: CellFault::Unreadable, old: None };

/// Flips a bit of a file, keeping its time: no fetch would read it within a day.
fn flip_unseen(path: &Path) {
    let modified = fs_err::metadata(path).expect("there").modified().expect("known");
    let mut bytes = fs_err::read(path).expect("there");
    bytes[600] ^= 1;
    fs_err::write(path, &bytes).expect("written");
    std::fs::OpenOptions::new().write(true).open(path).expect("there").set_modified(modified).expect("set");
}

#[test]
fn a_rotten_shard_costs_its_cell_only() {
    let scene = Published::new(1, &[0; 3], 40);
    let (_server, robot) = Robot::fetched(scene.clone());
    let path = robot.cache.shard_path(scene.hash(1, Profile::Compact));
    let faults: [(&str, &dyn Fn()); 3] = [
        ("a flipped bit", &|| flip_unseen(&path)),
        ("another file", &|| fs_err::write(&path, b"x").expect("written")),
        ("no file", &|| fs_err::remove_file(&path).expect("there")),
    ];
    for (name, damage) in faults {
        damage();
        // Whenever it is opened, and whatever an earlier snapshot holds.
        let mut before: Option<Snapshot> = None;
        for _ in 0..2 {
            let snapshot = Snapshot::open_after(&robot.cache, before.as_ref()).expect(name);
            assert_eq!((cells(&snapshot), &snapshot.bad_cells), (vec![0, 2], &vec![UNREADABLE]), "{name}");
            before = Some(snapshot);
        }
        let stat = robot.cache.current_stat().expect("there");
        assert_eq!(robot.fetch().expect("heals").downloaded.n_shards, 1, "{name}");
        assert_ne!(robot.cache.current_stat().unwrap(), stat, "{name}: readers see that they may open it");
        let snapshot = robot.snapshot();
        assert_holds(&snapshot, &scene, 0..3);
        assert_eq!(snapshot.bad_cells, [], "{name}");
        assert_eq!(robot.fetch().expect("nothing new").downloaded.n_shards, 0, "{name}");
    }
}

/// Each file on board, and substitutes for it. A reader comes first: it never blocks, and marks its finds.
#[test]
fn whatever_is_lost_is_put_back() {
    let scene = Published::new(1, &[0; 3], 40);
    let (_server, robot) = Robot::fetched(scene.clone());
    let current = robot.cache.current().expect("readable").expect("fetched");
    let mut paths = vec![robot.cache.current_path(), robot.cache.manifest_path(current.manifest_hash)];
    paths.extend(current.shards().map(|hash| robot.cache.shard_path(hash)));
    type Put = fn(&Path);
    let faults: [(&str, Put); 5] = [
        ("nothing", |_| {}),
        ("an empty file", |path| fs_err::write(path, b"").expect("written")),
        ("another file", |path| fs_err::write(path, b"{}").expect("written")),
        ("a folder", |path| fs_err::create_dir_all(path.join("inside")).expect("made")),
        ("a pipe", |path| {
            assert!(std::process::Command::new("mkfifo").arg(path).status().expect("runs").success());
        }),
    ];
    let heal = |context: &str| {
        drop(Snapshot::open(&robot.cache));
        robot.fetch().unwrap_or_else(|e| panic!("{context}: {e}"));
        let snapshot = Snapshot::open(&robot.cache).unwrap_or_else(|e| panic!("{context}: {e}"));
        assert_eq!(snapshot.bad_cells, [], "{context}");
        assert_holds(&snapshot, &scene, 0..3);
    };
    for path in &paths {
        for (name, put) in faults {
            let context = format!("{name} at {}", path.display());
            fs_err::remove_file(path).expect("there");
            put(path);
            heal(&context);
        }
    }
    // Files in the places of folders: a damaged shard cannot be marked at first.
    for name in ["damaged", "history", "manifests", "shards", "staging"] {
        let folder = robot.cache.dir().join(name);
        drop(std::fs::remove_dir_all(&folder));
        fs_err::write(&folder, "").expect("written");
        if name == "damaged" {
            flip_unseen(&robot.cache.shard_path(scene.hash(1, Profile::Compact)));
        }
        heal(name);
    }
    let lock = robot.cache.dir().join("lock");
    fs_err::remove_file(&lock).expect("there");
    faults[4].1(&lock);
    heal("a pipe for a lock");
}

/// Whichever bit of whichever shards flips: the others answer, as does a rotten one with whole columns (padding).
#[test]
fn any_rot_costs_its_cells_only() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let scene = Published::new(1, &[0; 3], 40);
    let server = Server::start(scene.clone());
    let files = Arc::new(SimFiles::default());
    let robot = Robot::on_sim(dir.path(), files.clone(), &server.url());
    robot.fetch().expect("works");
    let whole = answering(&robot.snapshot());
    let mut n_lost = 0;
    for seed in 0..200u64 {
        let mut random = slag_math::random::Random::new(seed);
        let files = Arc::new(files.fork(None, seed));
        let robot = Robot::on_sim(dir.path(), files.clone(), &server.url());
        let rotten = 1 + seed % 7;
        for id in (0..3u32).filter(|id| rotten >> id & 1 == 1) {
            files.flip(&robot.cache.shard_path(scene.hash(id, Profile::Compact)), &mut random);
        }
        let expected: Vec<u32> = (0..3).filter(|id| rotten >> id & 1 == 0).collect();
        match Snapshot::open(&robot.cache) {
            Ok(snapshot) => {
                let found = answering(&snapshot);
                assert!(found.iter().all(|cell| whole.contains(cell)), "seed {seed}: another answer");
                let holds = expected.iter().all(|id| cells(&snapshot).contains(id));
                assert!(holds, "seed {seed}: a whole cell is lost");
                assert_eq!(found.len() + snapshot.bad_cells.len(), 3, "seed {seed}");
                n_lost += snapshot.bad_cells.len();
            }
            Err(e) => assert_eq!(rotten, 7, "seed {seed}: {e}"),
        }
        robot.fetch().expect("heals");
        assert_holds(&robot.snapshot(), &scene, 0..3);
    }
    assert!(n_lost > 100, "{n_lost}");
}

/// All shards are read in turn, the rotten one is marked, and no snapshot takes it over.
#[test]
fn a_scrub_reads_each_shard_and_marks_the_rotten_one() {
    let scene = Published::new(1, &[0; 3], 40);
    let (_server, robot) = Robot::fetched(scene.clone());
    let (snapshot, mut scrubber) = (robot.snapshot(), Scrubber::default());
    let mut steps = |n: usize| -> Vec<(u32, bool)> {
        let step = |_| scrubber.step(&robot.cache, &snapshot).map(|step| (step.cell_id, step.is_sound));
        (0..n).filter_map(step).collect()
    };
    assert_eq!(steps(6), [0, 1, 2, 0, 1, 2].map(|id| (id, true)));
    flip_unseen(&robot.cache.shard_path(scene.hash(1, Profile::Compact)));
    assert_eq!(robot.fetch().expect("reads none").downloaded.n_shards, 0);
    assert_eq!(steps(2), [(0, true), (1, false)]);
    let after = Snapshot::open_after(&robot.cache, Some(&snapshot)).expect("the others are whole");
    assert_eq!((cells(&after), &after.bad_cells), (vec![0, 2], &vec![UNREADABLE]));
    assert_eq!(robot.fetch().expect("heals").downloaded.n_shards, 1);
    assert_holds(&robot.snapshot(), &scene, 0..3);
}

/// A new generation shares the previous one's open shards, except replaced ones.
#[test]
fn open_shards_are_shared_by_generations() {
    let (server, robot) = Robot::fetched(Published::new(1, &[0; 3], 40));
    let first = robot.snapshot();
    let next = Published::new(2, &[0, 7, 0], 40);
    server.publish(next.clone());
    assert_eq!(robot.fetch().expect("works").downloaded.n_shards, 1);
    let second = Snapshot::open_after(&robot.cache, Some(&first)).expect("opens");
    let is_shared = |at: usize| Arc::ptr_eq(&first.shards[at], &second.shards[at]);
    assert_eq!([0, 1, 2].map(is_shared), [true, false, true]);
    assert_holds(&second, &next, 0..3);
    // A replaced file is opened anew, even under the same name.
    std::thread::sleep(Duration::from_millis(20));
    let path = robot.cache.shard_path(second.current.cells[0].hash);
    let copy = path.with_extension("copy");
    fs_err::copy(&path, &copy).expect("copied");
    fs_err::rename(&copy, &path).expect("renamed");
    let third = Snapshot::open_after(&robot.cache, Some(&second)).expect("opens");
    assert!(!Arc::ptr_eq(&second.shards[0], &third.shards[0]));
}

/// A robot in service finds rot by itself and fetches the shard, although no other fetch is due.
#[test]
fn a_robot_in_service_heals_rot() {
    let scene = Published::new(1, &[0; 3], 40);
    let (_server, robot) = Robot::started(scene.clone());
    let (following, cancel) = (Arc::<Following>::default(), AtomicBool::new(false));
    let engine = Engine::new(robot.cache.clone(), text_service());
    let app = App::following(engine, Settings::default(), Some(Arc::clone(&following)));
    let settings = FollowSettings {
        radius: 20.0,
        min_interval: Duration::ZERO,
        refresh: None,
        ..FollowSettings::default()
    };
    let (fetched, fetches) = mpsc::channel();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let environment = FollowEnvironment {
                fetch: &mut |_| robot.fetch(),
                report: &mut |outcome| {
                    app.reload_now();
                    fetched.send(outcome.as_ref().expect("works").downloaded.n_shards).expect("awaited");
                },
                random: &|| 0.5,
                cancel: &cancel,
            };
            follow(&robot.cache, &robot.request, settings, &following, environment)
        });
        following.post(at(5.0));
        let next = || fetches.recv_timeout(Duration::from_secs(60)).ok();
        let first = next();
        flip_unseen(&robot.cache.shard_path(scene.hash(1, Profile::Compact)));
        scope.spawn(|| keep_scrubbing(&app, Duration::ZERO, &cancel));
        let second = next();
        cancel.store(true, Ordering::Relaxed);
        assert_eq!((first, second), (Some(3), Some(1)));
    });
    assert_holds(&robot.snapshot(), &scene, 0..3);
}
