//! Storage and network fail together, in a thousand trials (a quarter of them outside the nightly checks;
//! `SLAG_TRIALS=10000`: more). After each, the old or the new generation answers a real query, whole. Storage
//! includes the two copies of the trust state, and the usage records.

use super::*;

use slag_edge::query::{AnswerKind, QueryRequest};
use slag_edge::text::{EncoderInfo, TextService};
use slag_models::{InferenceError, TextEncoder};

use super::crash::rot_one_copy;
use super::scene::DIM;

const SECOND: RootKeys = RootKeys { root: 3, online: 4 };
const N_THREADS: u64 = 4;
/// Gaussians per cell: its shard arrives in several pieces.
const N: u32 = 60;

/// A robot's network timeout in a trial.
const SILENCE: Duration = Duration::from_millis(80);

fn n_trials() -> u64 {
    std::env::var("SLAG_TRIALS").map_or(trials(250, 1000), |n| n.parse().expect("SLAG_TRIALS is a number"))
}

/// Encodes every text as the first axis, at a cosine of 0.5 to every centroid of these scenes.
struct FirstAxis;

impl TextEncoder for FirstAxis {
    fn dim(&self) -> usize {
        DIM as usize
    }

    fn encode(&mut self, _: &str) -> Result<Vec<f32>, InferenceError> {
        Ok((0..DIM).map(|axis| if axis == 0 { 1.0 } else { 0.0 }).collect())
    }
}

/// Micrometres.
type Place = [i64; 3];

fn place(position: [f64; 3]) -> Place {
    position.map(|v| (v * 1e6).round() as i64)
}

pub fn text_service() -> TextService {
    let info = EncoderInfo { name: "e".into(), id: ENCODER, dim: DIM, execution_provider: "none" };
    TextService::start(info, Box::new(FirstAxis)).expect("a thread")
}

/// Queries everything; returns the generation and the positions found.
fn ask(cache: EdgeCache) -> Result<(u64, BTreeSet<Place>), String> {
    let engine = Engine::new(cache, text_service());
    engine.reload().map_err(|e| slag_edge::error_line(&e))?;
    let request =
        QueryRequest { kind: Some(AnswerKind::Gaussians), limit: Some(10_000), ..QueryRequest::new("x") };
    let on_board = engine.on_board().map_err(|e| e.to_string())?;
    let reply = on_board.answer(request, &slag_edge::score::Budget::default()).map_err(|e| e.to_string())?;
    let answers = reply.answers.first().expect("of one text");
    let found = reply.gaussians(answers).iter().map(|g| place(g.position_in_world.into())).collect();
    Ok((answers.generation, found))
}

/// Oracle: the published positions.
fn expected(published: &Published, cell_ids: std::ops::Range<u32>) -> BTreeSet<Place> {
    let of_cell = |cell_id| {
        let bytes = AlignedBytes::copy_of(&published.objects[&published.hash(cell_id, Profile::Compact)]);
        let layout = ShardLayout::check(&bytes).expect("sound");
        let view = layout.view(&bytes);
        (0..N as usize).map(|i| place(view.position_in_world(i).into())).collect::<Vec<_>>()
    };
    cell_ids.flat_map(of_cell).collect()
}

/// Start of a thread's trials: generation 2 on board, 3 offered, 1 for replays.
struct Stage {
    dir: tempfile::TempDir,
    server: Server,
    stale: Published,
    old: Published,
    new: Published,
    before: SimFiles,
    is_key_change: bool,
}

/// Counts of outcomes: a harness where fetches always fail, or never, tests nothing.
#[derive(Debug, Default)]
struct Outcomes {
    worked: AtomicU64,
    in_part: AtomicU64,
    kept_old: AtomicU64,
    failed_with_new: AtomicU64,
}

impl Stage {
    fn new(is_key_change: bool) -> Self {
        // In memory if possible: these records are not under test.
        let shm = Path::new("/dev/shm");
        let dir = if shm.is_dir() { tempfile::tempdir_in(shm) } else { tempfile::tempdir() };
        let dir = dir.expect("temporary folder");
        let stale = Published::new(1, &[9; 7], N);
        let old = Published::new(2, &[0; 7], N);
        let mut new = Published::new(3, &[0, 0, 5, 0, 5, 0, 0], N);
        if is_key_change {
            new = new.signed_by(&[FIRST, SECOND], 3);
        }
        let server = Server::start(old.clone());
        let files = Arc::new(SimFiles::default());
        Robot::on_sim(dir.path(), files.clone(), &server.url()).fetch().expect("works");
        server.publish(new.clone());
        Self { dir, server, stale, old, new, before: files.fork(None, 0), is_key_change }
    }

    /// Oracle: positions of a generation without these bad cells.
    fn expected(&self, generation: u64, bad_cells: &[BadCell]) -> BTreeSet<Place> {
        if generation == 2 {
            return expected(&self.old, 0..3);
        }
        let of_cell = |id: u32| match bad_cells.iter().find(|bad| bad.cell_id == id) {
            None => expected(&self.new, id..id + 1),
            Some(BadCell { old: Some(_), .. }) => expected(&self.old, id..id + 1),
            Some(_) => BTreeSet::new(),
        };
        (1..5).flat_map(of_cell).collect()
    }

    /// The robot moves from cells 0..3 to cells 1..5, and cell 0 must be freed.
    fn robot(&self, files: &Arc<SimFiles>) -> Robot {
        let mut robot = Robot::on_sim(self.dir.path(), files.clone(), &self.server.url());
        robot.go(30.0, 15.0, &self.new, 1..5);
        robot
    }

    fn network(&self, seed: u64) -> impl FnMut(&Seen) -> Fault + Send + 'static {
        let mut random = Random::new(seed ^ 0x6e65_7477);
        let one_in = [u64::MAX, 6, 3][random.below(3) as usize];
        // A shard that is never served whole.
        let bad = (random.below(4) == 0).then(|| {
            let hash = self.new.hash(2 + random.below(3) as u32, Profile::Compact);
            let fault = [Fault::Status(404), Fault::Corrupt(700)][random.below(2) as usize].clone();
            (format!("/v1/objects/{hash}"), fault)
        });
        let stale = self.stale.clone();
        let pairs: Vec<(String, Vec<u8>)> = (0..7)
            .map(|id| {
                let name = format!("/v1/objects/{}", self.new.hash(id, Profile::Compact));
                (name, stale.objects[&stale.hash(id, Profile::Compact)].clone())
            })
            .collect();
        move |seen| {
            if let Some((_, fault)) = bad.as_ref().filter(|(path, _)| *path == seen.path) {
                return fault.clone();
            }
            // Refused metadata is not requested again, so most of it is spared.
            let is_spared = !seen.path.contains("objects") && random.below(4) != 0;
            if is_spared || random.below(one_in) != 0 {
                return Fault::None;
            }
            match random.below(16) {
                // Silent, endless, and elsewhere.
                12 => Fault::Stall,
                13 => Fault::Endless,
                14 => Fault::Redirect("http://127.0.0.1:1/".into()),
                15 => Fault::ShiftedRange(1 + random.below(600) as usize),
                0 | 1 => Fault::Cut(random.below(1500) as usize),
                // Truncated, with a matching announced length.
                2 => Fault::Length(-(1 + random.below(200) as i64)),
                3 => Fault::Length(1 + random.below(200) as i64),
                4 => Fault::Delay(Duration::from_millis(1 + random.below(4))),
                5 => Fault::Corrupt(random.below(4000) as usize),
                6 => Fault::Status([500, 502, 503, 404, 416][random.below(5) as usize]),
                7 => Fault::IgnoreRange,
                8 => Fault::ShiftedRange(random.below(100) as usize),
                9 => Fault::RetryAfter(503, 1),
                // A replayed old state; or an intact shard of the same cell and length under another hash.
                _ if seen.path.ends_with("timestamp.json") => {
                    Fault::Instead(stale.metadata["timestamp.json"].clone())
                }
                _ if seen.path.contains("/targets/") => Fault::Instead(stale.listed.clone()),
                _ => match pairs.iter().find(|(name, _)| *name == seen.path) {
                    Some((_, other)) => Fault::Instead(other.clone()),
                    None => Fault::None,
                },
            }
        }
    }

    fn trial(&self, seed: u64, outcomes: &Outcomes) {
        let mut random = Random::new(seed);
        self.server.faults(self.network(seed));
        // A fetch without faults takes about 50 steps.
        let (storage, step) = (random.below(4), 1 + random.below(55));
        let files = Arc::new(self.before.fork((storage == 1).then_some(step), seed));
        files.fail_at((storage == 2).then_some(step));
        let capacity_bytes = self.before.used_bytes() + random.below(8000);
        files.limit((storage == 3).then_some(capacity_bytes), seed.is_multiple_of(2));
        let mut robot = self.robot(&files);
        if seed % 8 == 5 {
            files.flip(&robot.cache.dir().join("usage.json"), &mut random);
        }
        robot.request.parallel = 1 + random.below(3) as usize;
        robot.limits.attempts = 4;
        robot.limits.read_timeout = SILENCE;
        robot.limits.longest_retry_after = Duration::from_millis(2);
        let result = robot.fetch();

        // The power fails now, unless it failed before: unsynced data may be lost, torn or reordered.
        let context = format!("seed {seed}, storage {storage} at step {step}: {result:?}");
        let files = match random.below(3) {
            0 if storage != 1 => Arc::new(files.fork(None, seed)),
            _ => Arc::new(files.after_power_cut(seed)),
        };
        files.limit(None, true);
        files.fail_at(None);
        let robot = self.robot(&files);
        rot_one_copy(&files, robot.cache.dir(), seed);
        let bad_cells = robot.snapshot().bad_cells;
        let (generation, found) = ask(robot.cache.clone()).unwrap_or_else(|e| panic!("{context}: {e}"));
        assert!(
            found == self.expected(generation, &bad_cells),
            "{context}: generation {generation} answers with {} places",
            found.len()
        );
        // Cell 1 is on board unchanged, cell 2 as an old copy.
        let has_stand_in = |bad: &BadCell| bad.cell_id > 1 && bad.old.is_some() == (bad.cell_id == 2);
        assert!(bad_cells.iter().all(has_stand_in), "{context}: {bad_cells:?}");
        match (&result, generation) {
            (Ok(report), generation) => {
                assert_eq!(generation, 3, "{context}: what a fetch has said is there must be there");
                assert_eq!(report.bad_cells, bad_cells, "{context}");
                let outcome = if bad_cells.is_empty() { &outcomes.worked } else { &outcomes.in_part };
                outcome.fetch_add(1, Ordering::Relaxed);
            }
            (Err(_), 3) => drop(outcomes.failed_with_new.fetch_add(1, Ordering::Relaxed)),
            (Err(_), _) => drop(outcomes.kept_old.fetch_add(1, Ordering::Relaxed)),
        }

        self.server.faults(|_| Fault::None);
        // One copy of the trust state is whole and updated.
        if result.is_ok() && seed.is_multiple_of(2) {
            self.check_trust(&robot, &context);
        }
        robot.fetch().unwrap_or_else(|e| panic!("{context}: the next fetch: {}", slag_edge::error_line(&e)));
        assert_eq!(ask(robot.cache.clone()), Ok((3, self.expected(3, &[]))), "{context}");
        assert_eq!(robot.snapshot().bad_cells, [], "{context}");
        assert!(robot.staged().is_empty(), "{context}");
        if seed.is_multiple_of(4) {
            self.check_trust(&robot, &context);
        }
    }

    /// The robot accepted the new state in any case: old keys and old states are refused.
    fn check_trust(&self, robot: &Robot, context: &str) {
        let published = if self.is_key_change { Published::new(9, &[0; 7], N) } else { self.old.clone() };
        self.server.publish(published);
        match (robot.fetch(), self.is_key_change) {
            (Err(FetchError::Tuf(TufError::Signatures { .. })), true) => {}
            (Err(FetchError::Tuf(TufError::Rollback { seen: 3, offered: 2, .. })), false) => {}
            (other, _) => panic!("{context}: {other:?}"),
        }
        self.server.publish(self.new.clone());
    }
}

#[test]
fn a_thousand_faults_leave_a_whole_generation() {
    let (outcomes, n_trials) = (Outcomes::default(), n_trials());
    std::thread::scope(|scope| {
        for thread in 0..N_THREADS {
            let outcomes = &outcomes;
            scope.spawn(move || {
                // In every other thread the new generation comes under a new root.
                let stage = Stage::new(thread % 2 == 1);
                (thread..n_trials).step_by(N_THREADS as usize).for_each(|seed| stage.trial(seed, outcomes));
            });
        }
    });
    println!("{outcomes:?}");
    let Outcomes { worked, in_part, kept_old, failed_with_new } = outcomes;
    let seen = [worked, in_part, kept_old, failed_with_new].map(AtomicU64::into_inner);
    assert!(seen.iter().all(|n| *n >= n_trials / 100), "all outcomes are seen: {seen:?}");
}
