//! Power cuts after every step, and full disks: the old or the new generation remains, whole.

use super::*;

/// Damages one copy of the trust records, or neither: the medium rots while the power is off. Only if the power cut
/// damaged none: together they would be two faults.
pub fn rot_one_copy(files: &SimFiles, cache: &Path, seed: u64) {
    let mut random = Random::new(seed ^ 0x726f_7474);
    let copies = ["0", "1"].map(|name| cache.join("trust").join(name));
    let [first, second] =
        copies.each_ref().map(|path| files.read(path, u64::MAX).ok().map(|bytes| bytes.to_vec()));
    if first == second && random.below(3) > 0 {
        files.flip(&copies[random.below(2) as usize], &mut random);
    }
}

/// Two generations, the robot's two places, and the storage after the first fetch.
struct Trial {
    dir: tempfile::TempDir,
    server: Server,
    old: Published,
    new: Published,
    before: SimFiles,
}

impl Trial {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("temporary folder");
        let (old, new) = (Published::new(1, &[0; 7], 150), Published::new(2, &[0, 0, 5, 0, 5, 0, 0], 150));
        let server = Server::start(old.clone());
        let files = Arc::new(SimFiles::default());
        let robot = Robot::on_sim(dir.path(), files.clone(), &server.url());
        robot.fetch().expect("works");
        assert_holds(&robot.snapshot(), &old, 0..3);
        server.publish(new.clone());
        Self { dir, server, old, new, before: files.fork(None, 0) }
    }

    /// Moves to cells 1..5 (and frees cell 0) under the new generation.
    fn fetch(&self, files: &Arc<SimFiles>, parallel: usize) -> (Robot, Result<FetchReport, FetchError>) {
        let mut robot = Robot::on_sim(self.dir.path(), files.clone(), &self.server.url());
        robot.go(30.0, 15.0, &self.new, 1..5);
        robot.request.parallel = parallel;
        robot.limits.attempts = 20;
        let result = robot.fetch();
        (robot, result)
    }

    /// Cuts the power at a step of a fetch; returns whether the new generation was visible afterwards.
    fn cut(&self, step: u64, seed: u64) -> bool {
        let files = Arc::new(self.before.fork(Some(step), seed));
        let (_, result) = self.fetch(&files, 1);
        // Usage records come last, and fail no fetch.
        assert!(result.is_err() || files.n_steps() == step, "step {step} seed {seed}: the cut came too late");
        self.recover(&files, seed, &format!("step {step} seed {seed}"))
    }

    /// Restores the power; checks for a whole generation and that the next fetch works.
    fn recover(&self, files: &SimFiles, seed: u64, context: &str) -> bool {
        let files = Arc::new(files.after_power_cut(seed));
        let robot = Robot::on_sim(self.dir.path(), files.clone(), &self.server.url());
        rot_one_copy(&files, robot.cache.dir(), seed);
        let snapshot = Snapshot::open(&robot.cache).unwrap_or_else(|e| panic!("{context}: {e}: {:?}", e));
        let is_new = snapshot.manifest.generation == 2;
        match is_new {
            true => assert_holds(&snapshot, &self.new, 1..5),
            false => assert_holds(&snapshot, &self.old, 0..3),
        }

        let (robot, result) = self.fetch(&files, 2);
        result.unwrap_or_else(|e| panic!("{context}: the next fetch: {e}: {e:?}"));
        assert_holds(&robot.snapshot(), &self.new, 1..5);
        let mut expected: Vec<_> = (1..5).map(|id| self.new.hash(id, Profile::Compact)).collect();
        expected.sort();
        assert_eq!(robot.shards(), expected, "{context}: orphans");
        assert!(robot.staged().is_empty(), "{context}: {:?}", robot.staged());
        is_new
    }
}

#[test]
fn a_power_cut_at_any_step_leaves_a_whole_generation() {
    let trial = Trial::new();
    let files = Arc::new(trial.before.fork(None, 0));
    trial.fetch(&files, 1).1.expect("works");
    let n_steps = files.n_steps();
    let mut n_new = 0;
    for step in 1..=n_steps {
        for seed in 0..6 {
            n_new += u64::from(trial.cut(step, step * 100 + seed));
        }
    }
    assert!(n_new > 0 && n_new < n_steps * 6, "{n_new} of {n_steps} steps: both outcomes are seen");
}

/// A killed process leaves unsynced data; the next fetch must not rely on it.
#[test]
fn a_power_cut_after_a_killed_fetch() {
    let trial = Trial::new();
    let files = Arc::new(trial.before.fork(None, 0));
    trial.fetch(&files, 1).1.expect("works");
    for kill_step in 1..=files.n_steps() {
        for seed in kill_step * 100..kill_step * 100 + trials(2, 8) {
            let killed = Arc::new(trial.before.fork(Some(kill_step), seed));
            let _ = trial.fetch(&killed, 1);
            // If the step comes after the second fetch, the power fails after it.
            let cut_step = 1 + Random::new(seed).below(files.n_steps());
            let second = Arc::new(killed.fork(Some(cut_step), seed));
            let outcome = trial.fetch(&second, 1).1;
            assert!(outcome.is_err() || second.n_steps() <= cut_step, "seed {seed}");
            trial.recover(&second, seed, &format!("killed at {kill_step}, cut at {cut_step}, seed {seed}"));
        }
    }
}

/// The very first fetch leaves nothing, or the whole generation.
#[test]
fn a_power_cut_in_the_first_fetch() {
    let scene = Published::new(1, &[0; 3], 100);
    let server = Server::start(scene.clone());
    for step in 1.. {
        let dir = tempfile::tempdir().expect("temporary folder");
        let files = Arc::new(SimFiles::default().fork(Some(step), step));
        if Robot::on_sim(dir.path(), files.clone(), &server.url()).fetch().is_ok() {
            assert!(step > 10);
            break;
        }
        let robot = Robot::on_sim(dir.path(), Arc::new(files.after_power_cut(step)), &server.url());
        match Snapshot::open(&robot.cache) {
            Ok(snapshot) => assert_holds(&snapshot, &scene, 0..3),
            Err(e) => assert!(matches!(e, StoreError::Empty { .. }), "step {step}: {e}"),
        }
        robot.fetch().unwrap_or_else(|e| panic!("step {step}: {e}"));
        assert_holds(&robot.snapshot(), &scene, 0..3);
    }
}

/// With known free space, and with other programs using it up meanwhile.
#[test]
fn a_full_disk_leaves_the_old_generation() {
    let trial = Trial::new();
    let used_bytes = trial.before.used_bytes();
    let mut n_resumed = 0;
    for is_known in [true, false] {
        for free_bytes in (0..).step_by(400) {
            let files = Arc::new(trial.before.fork(None, 0));
            files.limit(Some(used_bytes + free_bytes), is_known);
            let (robot, result) = trial.fetch(&files, 2);
            let staged: Vec<String> = robot.staged().into_iter().filter(|name| name != "put0").collect();
            match result {
                Ok(_) => {
                    assert!(free_bytes > 1000);
                    break;
                }
                Err(FetchError::NoSpace { needed_bytes, .. }) => {
                    assert!(is_known && staged.is_empty(), "nothing is begun: {staged:?}");
                    assert!(needed_bytes > free_bytes, "{needed_bytes} are needed of {free_bytes}");
                }
                // The trust record precedes the check of free space.
                Err(FetchError::DiskFull { .. }) if !is_known || free_bytes < 8000 => {}
                Err(e) => panic!("space for {free_bytes}: {e}"),
            }
            assert_holds(&robot.snapshot(), &trial.old, 0..3);
            files.limit(None, true);
            let report = trial.fetch(&files, 2).1.expect("there is space again");
            assert_eq!(report.resumed_bytes > 0, !staged.is_empty(), "what arrived is kept: {staged:?}");
            n_resumed += u64::from(report.resumed_bytes > 0);
        }
    }
    assert!(n_resumed > 3, "{n_resumed}");
}
