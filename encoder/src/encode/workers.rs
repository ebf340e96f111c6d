//! The threads of a run. Two encodes in one process do not share them, and rayon's global pool stays as it is.
//!
//! Where there are as many pieces of work as threads, each piece has a thread of its own: threads that share a
//! piece wait for each other's parts, and take up another piece meanwhile, which the first then waits for. The
//! last pieces, too few for that, are shared. Results do not depend on who did the work.

use std::sync::{Mutex, PoisonError};

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// Stack of a thread: while it waits for others' part of its work, it may take up another piece.
const STACK_BYTES: usize = 8 << 20;

/// The threads of a run.
pub(crate) struct Workers {
    shared: ThreadPool,
    /// Pools of one thread that have no work; made as they are needed.
    alone: Mutex<Vec<ThreadPool>>,
}

fn start(n_threads: usize) -> Result<ThreadPool, ThreadPoolBuildError> {
    ThreadPoolBuilder::new().num_threads(n_threads).stack_size(STACK_BYTES).build()
}

impl Workers {
    /// Starts `n_threads` threads.
    pub(crate) fn start(n_threads: usize) -> Result<Self, ThreadPoolBuildError> {
        Ok(Self { shared: start(n_threads)?, alone: Mutex::default() })
    }

    /// Returns the threads that share work.
    pub(crate) fn shared(&self) -> &ThreadPool {
        &self.shared
    }

    /// Returns how many of `n_pieces`, the first ones, get a thread of their own where `n_at_once` are worked on
    /// at a time.
    pub(crate) fn n_alone(&self, n_pieces: usize, n_at_once: usize) -> usize {
        let n_threads = self.shared.current_num_threads();
        // Fewer pieces than threads would leave threads without work.
        if n_threads == 1 || n_at_once < n_threads { 0 } else { n_pieces - n_pieces % n_at_once }
    }

    /// Runs a piece of work on a thread of its own, or on all threads. The caller is none of them and only waits.
    pub(crate) fn run<T: Send>(&self, is_alone: bool, work: impl FnOnce() -> T + Send) -> T {
        let free = || self.alone.lock().unwrap_or_else(PoisonError::into_inner);
        let pool = is_alone.then(|| free().pop().map_or_else(|| start(1), Ok));
        match pool {
            Some(Ok(pool)) => {
                let result = pool.install(work);
                free().push(pool);
                result
            }
            // Where the system starts no more threads, those that there are do it.
            Some(Err(_)) | None => self.shared.install(work),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use rayon::prelude::*;

    use super::*;

    /// Pieces that wait for each other end only if each has a thread; the parts of one are done by that thread.
    #[test]
    fn each_piece_has_a_thread_of_its_own() {
        let workers = Workers::start(3).expect("starts");
        let all_began = Barrier::new(3);
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    workers.run(true, || {
                        all_began.wait();
                        let of_parts = (0..100).into_par_iter().map(|_| std::thread::current().id());
                        let own = std::thread::current().id();
                        assert!(of_parts.collect::<Vec<_>>().iter().all(|id| *id == own));
                    });
                });
            }
        });
        assert_eq!(workers.alone.lock().expect("not poisoned").len(), 3, "they are used again");
        workers.run(false, || assert_eq!(rayon::current_num_threads(), 3));
    }

    #[test]
    fn the_last_pieces_are_shared() {
        let workers = Workers::start(4).expect("starts");
        assert_eq!([0, 3, 4, 7, 8].map(|n| workers.n_alone(n, 4)), [0, 0, 4, 4, 8]);
        assert_eq!(workers.n_alone(9, 3), 0, "a thread would have no work");
        assert_eq!(Workers::start(1).expect("starts").n_alone(9, 1), 0);
    }
}
