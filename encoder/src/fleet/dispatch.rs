//! Which views a worker takes. Without a queue that is its share, every n-th view; when it is done, and the others
//! take long, the worker does what is left of theirs: a machine that went away must not hold up the rest.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::encode::EncodeError;

/// Returns the open views' indices, in the order in which to begin them.
pub(super) type OpenViews<'a> = &'a mut dyn FnMut() -> Result<Vec<usize>, EncodeError>;

/// Gives a worker its views, by index in the plan.
pub(super) trait Dispatcher: Sync {
    /// Called before views are taken, and again after [`Dispatcher::wait`].
    fn offer(&self, open: OpenViews<'_>) -> Result<(), EncodeError>;

    /// The next view, without waiting; `None` if there is none at present.
    fn take(&self) -> Option<usize>;

    /// The view's contributions, or its failure, are in the bucket.
    fn done(&self, view: usize);

    /// Waits at most `pause`; returns whether there may be a view.
    fn wait(&self, pause: Duration) -> bool;

    /// Views that were handed out too often without a result.
    fn take_dead(&self) -> Vec<usize> {
        Vec::new()
    }
}

pub(super) struct Share {
    index: usize,
    of: usize,
    help_after: Duration,
    progress: Mutex<Progress>,
}

struct Progress {
    todo: VecDeque<usize>,
    /// End of the own share, or of the last help.
    idle_since: Instant,
    /// Whether the next offer includes others' shares.
    helps: bool,
}

impl Share {
    pub(super) fn new(index: usize, of: usize, help_after: Duration) -> Self {
        let progress = Progress { todo: VecDeque::new(), idle_since: Instant::now(), helps: false };
        Self { index, of, help_after, progress: Mutex::new(progress) }
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Dispatcher for Share {
    fn offer(&self, open: OpenViews<'_>) -> Result<(), EncodeError> {
        let open = open()?;
        let mut progress = self.progress();
        let is_chosen = |view: &usize| progress.helps || view % self.of == self.index;
        let mut chosen: VecDeque<usize> = open.into_iter().filter(is_chosen).collect();
        // Helpers begin at different places, to do few views twice.
        if progress.helps && !chosen.is_empty() {
            let at = self.index * chosen.len() / self.of;
            chosen.rotate_left(at);
        }
        *progress = Progress { todo: chosen, idle_since: Instant::now(), helps: false };
        Ok(())
    }

    fn take(&self) -> Option<usize> {
        let mut progress = self.progress();
        let view = progress.todo.pop_front()?;
        progress.idle_since = Instant::now();
        Some(view)
    }

    fn done(&self, _view: usize) {
        self.progress().idle_since = Instant::now();
    }

    fn wait(&self, pause: Duration) -> bool {
        std::thread::sleep(pause);
        let mut progress = self.progress();
        progress.helps = progress.idle_since.elapsed() >= self.help_after;
        progress.helps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: worker 1 of 3 of 7 views, which then helps.
    #[test]
    fn a_worker_does_its_share_and_then_what_others_left() {
        let share = Share::new(1, 3, Duration::ZERO);
        let offer = |share: &Share, views: &[usize]| share.offer(&mut || Ok(views.to_vec())).expect("offers");
        let taken = || std::iter::from_fn(|| share.take()).collect::<Vec<_>>();
        offer(&share, &[6, 5, 4, 3, 2, 1, 0]);
        assert_eq!(taken(), [4, 1]);
        assert!(share.wait(Duration::ZERO));
        offer(&share, &[6, 3, 0]);
        assert_eq!(taken(), [3, 0, 6]);
        let patient = Share::new(0, 2, Duration::from_secs(3600));
        offer(&patient, &[1]);
        assert!(!patient.wait(Duration::ZERO), "it waits for the other");
        assert!(patient.take().is_none());
    }
}
