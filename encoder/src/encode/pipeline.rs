//! Views on their way through stages that overlap: while a device has one view, the cores prepare the next.
//!
//! Each stage has as many slots as views may be in it at once, and a queue as long. A free thread takes the most
//! advanced view, so that views leave before others enter and few are in memory. Stages on the processor share its
//! cores; one that waits for a GPU or the disk takes none. Without devices this is a thread a core, each with a view.

use std::collections::VecDeque;
use std::ops::RangeInclusive;
use std::panic::{self, AssertUnwindSafe};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Instant;

use super::report::StageReport;

#[derive(Clone, Debug)]
pub(super) struct Stage {
    pub(super) name: &'static str,
    /// Most views in it at once, at least 1.
    pub(super) n_slots: usize,
    /// Whether it keeps a core busy rather than a GPU or a disk.
    pub(super) on_cpu: bool,
}

/// Most items in a range of stages, or waiting between them.
pub(super) fn most_under_way(stages: &[Stage], of: RangeInclusive<usize>, n_cores: usize) -> usize {
    let (first, last) = (*of.start(), *of.end());
    let is_fed_back = |at: usize| !stages[at].on_cpu && stages[at..].iter().any(|stage| stage.on_cpu);
    if !(first..stages.len()).any(is_fed_back) {
        // A core takes an item straight on to the next stage.
        return n_cores;
    }
    // An item in a stage has its place in the next queue reserved.
    let n_places = |at: usize| stages[at].n_slots.max(stages[at + 1].n_slots);
    (first..last).map(n_places).sum::<usize>() + stages[last].n_slots
}

struct Schedule<T, E> {
    /// Before each stage but the first.
    waiting: Vec<VecDeque<T>>,
    n_running: Vec<usize>,
    is_asking: bool,
    /// The source had nothing, and no step has ended since.
    has_no_more: bool,
    /// Ended steps, now and when the source was asked.
    n_ended: usize,
    n_ended_when_asked: usize,
    busy_secs: Vec<f64>,
    /// `Err` after a panic.
    failure: Option<std::thread::Result<E>>,
}

/// Takes items of `source` through the stages, `n_cores` at a time on the processor. A source that has nothing is
/// asked again whenever a stage has room, until nothing is under way; it may block, while stages go on.
///
/// `step` does a stage's work (by index) and returns the next stage's input; `None` ends an item.
///
/// # Errors
/// The first that `step` returned; what is under way is then given up.
pub(super) fn run<T: Send, E: Send>(
    stages: &[Stage],
    n_cores: usize,
    source: impl Iterator<Item = T> + Send,
    step: impl Fn(usize, T) -> Result<Option<T>, E> + Sync,
) -> Result<Vec<StageReport>, E> {
    let start = Instant::now();
    let (source, changed) = (Mutex::new(source), Condvar::new());
    let schedule = Mutex::new(Schedule {
        waiting: stages.iter().map(|_| VecDeque::new()).collect(),
        n_running: vec![0; stages.len()],
        is_asking: false,
        has_no_more: false,
        n_ended: 0,
        n_ended_when_asked: 0,
        busy_secs: vec![0.0; stages.len()],
        failure: None,
    });
    let n_elsewhere: usize = stages.iter().filter(|stage| !stage.on_cpu).map(|stage| stage.n_slots).sum();
    let lock = || schedule.lock().unwrap_or_else(PoisonError::into_inner);
    let timed_step = |stage: usize, item: T| {
        let begun = Instant::now();
        let result = step(stage, item);
        Some((begun.elapsed().as_secs_f64(), result))
    };
    let work = || {
        let mut schedule = lock();
        while schedule.failure.is_none() {
            let Some((at, item)) = schedule.take(stages, n_cores) else {
                // Nothing is under way and nothing can begin.
                if schedule.n_running.iter().all(|n| *n == 0) {
                    break;
                }
                schedule = changed.wait(schedule).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            drop(schedule);
            // A panic must not leave the other threads waiting.
            let done = panic::catch_unwind(AssertUnwindSafe(|| match item {
                Some(item) => timed_step(at, item),
                None => {
                    let item = source.lock().unwrap_or_else(PoisonError::into_inner).next();
                    lock().end_asking(item.is_some());
                    changed.notify_all();
                    timed_step(at, item?)
                }
            }));
            schedule = lock();
            schedule.end_step(at, done);
            changed.notify_all();
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..n_cores + n_elsewhere {
            scope.spawn(work);
        }
    });
    let Schedule { busy_secs, failure, .. } = schedule.into_inner().unwrap_or_else(PoisonError::into_inner);
    match failure {
        Some(Ok(error)) => return Err(error),
        Some(Err(panic)) => panic::resume_unwind(panic),
        None => {}
    }
    let wall_secs = start.elapsed().as_secs_f64();
    let report = |(stage, busy_secs): (&Stage, f64)| StageReport {
        stage: stage.name.to_owned(),
        n_slots: stage.n_slots,
        busy_secs,
        busy_share: busy_secs / (wall_secs * stage.n_slots as f64),
        gpus: Vec::new(),
    };
    Ok(stages.iter().zip(busy_secs).map(report).collect())
}

/// Seconds and result of a step; `None` if the source had no item for it.
type StepOutcome<T, E> = Option<(f64, Result<Option<T>, E>)>;

impl<T, E> Schedule<T, E> {
    /// Takes the most advanced item that can go on, with its stage; `None` in place of one that is to begin.
    fn take(&mut self, stages: &[Stage], n_cores: usize) -> Option<(usize, Option<T>)> {
        let on_cpu = stages.iter().zip(&self.n_running).filter(|(stage, _)| stage.on_cpu);
        let has_core = on_cpu.map(|(_, n)| n).sum::<usize>() < n_cores;
        for (at, stage) in stages.iter().enumerate().rev() {
            // An item in the stage has its place in the next queue, which is as long as either's slots.
            let has_room = stages.get(at + 1).is_none_or(|next| {
                self.waiting[at + 1].len() + self.n_running[at] < stage.n_slots.max(next.n_slots)
            });
            if self.n_running[at] >= stage.n_slots || !has_room || (stage.on_cpu && !has_core) {
                continue;
            }
            let item = self.waiting[at].pop_front();
            let may_begin = at == 0 && !self.is_asking && !self.has_no_more;
            if item.is_some() || may_begin {
                self.n_running[at] += 1;
                if at == 0 {
                    (self.is_asking, self.n_ended_when_asked) = (true, self.n_ended);
                }
                return Some((at, item));
            }
        }
        None
    }

    fn end_asking(&mut self, has_item: bool) {
        self.is_asking = false;
        self.has_no_more = !has_item && self.n_ended == self.n_ended_when_asked;
    }

    fn end_step(&mut self, at: usize, done: std::thread::Result<StepOutcome<T, E>>) {
        self.n_running[at] -= 1;
        let (secs, result) = match done {
            Ok(Some(done)) => done,
            Ok(None) => return,
            Err(panic) => return self.failure = Some(Err(panic)),
        };
        self.busy_secs[at] += secs;
        self.n_ended += 1;
        self.has_no_more = false;
        match result {
            Ok(Some(item)) if at + 1 < self.waiting.len() => self.waiting[at + 1].push_back(item),
            Ok(_) => {}
            Err(error) => drop(self.failure.get_or_insert(Ok(error))),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::{Arc, mpsc};
    use std::time::Duration;

    use super::*;

    fn stage(name: &'static str, n_slots: usize, on_cpu: bool) -> Stage {
        Stage { name, n_slots, on_cpu }
    }

    /// Every item passes all stages in order; slots, cores and queues are never exceeded; nothing is lost.
    #[test]
    fn slots_cores_and_queues_are_kept() {
        let stages = [
            stage("a", 3, true),
            stage("b", 1, false),
            stage("c", 3, true),
            stage("d", 2, false),
            stage("e", 3, true),
        ];
        let n_cores = 3;
        let running: [AtomicUsize; 5] = Default::default();
        let (on_cpu, begun, ended) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicUsize::new(0));
        let most_under_way = AtomicUsize::new(0);
        let done = Mutex::new(BTreeSet::new());
        let reports = run::<_, ()>(&stages, n_cores, (0..200).map(|id| (id, 0)), |at, (id, passed)| {
            assert_eq!(at, passed, "item {id}");
            if at == 0 {
                begun.fetch_add(1, Ordering::SeqCst);
            }
            let under_way = begun.load(Ordering::SeqCst).saturating_sub(ended.load(Ordering::SeqCst));
            most_under_way.fetch_max(under_way, Ordering::SeqCst);
            assert!(running[at].fetch_add(1, Ordering::SeqCst) < stages[at].n_slots, "slots of {at}");
            if stages[at].on_cpu {
                assert!(on_cpu.fetch_add(1, Ordering::SeqCst) < n_cores, "cores");
            }
            std::thread::sleep(Duration::from_micros(id * 7 % 50 * (at as u64 + 1)));
            if stages[at].on_cpu {
                on_cpu.fetch_sub(1, Ordering::SeqCst);
            }
            running[at].fetch_sub(1, Ordering::SeqCst);
            if at == 4 {
                ended.fetch_add(1, Ordering::SeqCst);
                done.lock().expect("not poisoned").insert(id);
            }
            Ok(Some((id, passed + 1)))
        })
        .expect("no error");
        assert_eq!(done.into_inner().expect("not poisoned").len(), 200);
        // Four queues of 3 each, with the items on their way in, and 3 in the last stage.
        let most = most_under_way.into_inner();
        assert!((4..=15).contains(&most), "{most}");
        assert_eq!(reports.len(), 5);
        for report in &reports {
            let holds = report.busy_secs > 0.0 && report.busy_share > 0.0 && report.busy_share <= 1.0;
            assert!(holds, "{report:?}");
        }
    }

    /// The only core prepares the second item while a device has the first, which it keeps until then.
    #[test]
    fn a_device_does_not_stop_the_cores() {
        let stages = [stage("prepare", 1, true), stage("device", 1, false)];
        let (prepared, seen) = mpsc::channel();
        let seen = Mutex::new(seen);
        run::<_, ()>(&stages, 1, 0..2, |at, item| {
            if at == 0 && item == 1 {
                prepared.send(()).expect("someone listens");
            }
            if at == 1 && item == 0 {
                let waited = seen.lock().expect("not poisoned").recv_timeout(Duration::from_secs(20));
                waited.expect("the second item was not prepared meanwhile");
            }
            Ok(Some(item))
        })
        .expect("no error");
    }

    #[test]
    fn what_is_furthest_goes_first() {
        let stages = [stage("a", 1, true), stage("b", 1, true), stage("c", 1, true)];
        let order = Mutex::new(Vec::new());
        run::<_, ()>(&stages, 1, 0..2, |at, item| {
            order.lock().expect("not poisoned").push((item, at));
            Ok(Some(item))
        })
        .expect("no error");
        let order = order.into_inner().expect("not poisoned");
        assert_eq!(order, [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]);
    }

    #[test]
    fn items_end_where_nothing_is_returned_and_errors_end_all() {
        let stages = [stage("a", 2, true), stage("b", 2, true)];
        let n_second = AtomicUsize::new(0);
        let step = |at: usize, item: u32| {
            n_second.fetch_add(at, Ordering::SeqCst);
            Ok::<_, ()>(item.is_multiple_of(2).then_some(item))
        };
        run(&stages, 2, 0..10, step).expect("no error");
        assert_eq!(n_second.into_inner(), 5);

        let n_begun = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&n_begun);
        let source = (0..1_000_000).inspect(move |_| {
            counted.fetch_add(1, Ordering::SeqCst);
        });
        let failed =
            run(&stages, 2, source, |_, item: u32| if item == 7 { Err(item) } else { Ok(Some(item)) });
        assert_eq!(failed.expect_err("it failed"), 7);
        assert!(n_begun.load(Ordering::SeqCst) < 100);
    }

    #[test]
    #[should_panic(expected = "a broken source")]
    fn a_panic_of_the_source_is_passed_on() {
        let stages = [stage("a", 2, true), stage("b", 2, false)];
        let source = (0..10).inspect(|item| assert!(*item != 3, "a broken source"));
        let _ = run::<_, ()>(&stages, 2, source, |_, item| Ok(Some(item)));
    }

    /// A source that blocks, such as a fleet's queue, holds up no stage.
    #[test]
    fn stages_go_on_while_the_source_is_asked() {
        let stages = [stage("a", 2, true), stage("b", 2, false)];
        let (done, is_done) = mpsc::channel();
        let (done, is_done) = (Mutex::new(done), Mutex::new(is_done));
        let source = (0..2).inspect(|item| {
            if *item == 1 {
                let waited = is_done.lock().expect("not poisoned").recv_timeout(Duration::from_secs(20));
                waited.expect("the first item did not go on meanwhile");
            }
        });
        run::<_, ()>(&stages, 2, source, |at, item| {
            if (at, item) == (1, 0) {
                done.lock().expect("not poisoned").send(()).expect("someone listens");
            }
            Ok(Some(item))
        })
        .expect("no error");
    }

    /// By hand: cores take items all the way; with a device between, each boundary holds as many as either side's
    /// slots.
    #[test]
    fn items_under_way_are_bounded() {
        let of_cpu = [stage("a", 3, true), stage("b", 3, true), stage("disk", 1, false)];
        assert_eq!(most_under_way(&of_cpu, 0..=1, 3), 3);
        let of_gpu =
            [stage("a", 3, true), stage("gpu", 12, false), stage("c", 3, true), stage("disk", 1, false)];
        assert_eq!(most_under_way(&of_gpu, 0..=2, 3), 12 + 12 + 3);
    }

    #[test]
    #[should_panic(expected = "a broken stage")]
    fn a_panic_is_passed_on() {
        let stages = [stage("a", 2, true), stage("b", 2, false)];
        let _ = run::<_, ()>(&stages, 2, 0..10, |at, item| {
            assert!(at == 0 || item != 3, "a broken stage");
            Ok(Some(item))
        });
    }
}
