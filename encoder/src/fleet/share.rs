//! A worker's share without a queue: every n-th view and cell. When it is done, and the others take long, the worker does
//! what is left of theirs: a machine that went away must not hold up the rest.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::dispatch::{Dispatcher, Item, Kind, OpenItems};
use super::error::FleetError;

/// The share of worker `index` of `of`.
pub(super) struct Share {
    index: usize,
    of: usize,
    help_after: Duration,
    state: Mutex<State>,
}

struct State {
    todo: VecDeque<Item>,
    /// When the own share was done, or help was last given.
    idle_since: Instant,
    /// Whether the next offer is of others' shares.
    helps: bool,
}

impl Share {
    pub(super) fn new(index: usize, of: usize, help_after: Duration) -> Self {
        let state = State { todo: VecDeque::new(), idle_since: Instant::now(), helps: false };
        Self { index, of, help_after, state: Mutex::new(state) }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether an item belongs to this worker's share.
    fn is_own(&self, item: Item) -> bool {
        let number = match item {
            Item::View(number) => number,
            Item::Cell(cell) => cell as usize,
        };
        number % self.of == self.index
    }
}

impl Dispatcher for Share {
    fn offer(&self, open: OpenItems<'_>) -> Result<(), FleetError> {
        let open = open()?;
        let mut state = self.state();
        let mut chosen: VecDeque<Item> =
            open.into_iter().filter(|item| state.helps || self.is_own(*item)).collect();
        // Helpers begin at different places, so that few of them do the same.
        if state.helps && !chosen.is_empty() {
            let at = self.index * chosen.len() / self.of;
            chosen.rotate_left(at);
        }
        state.todo = chosen;
        state.helps = false;
        state.idle_since = Instant::now();
        Ok(())
    }

    fn take(&self, kind: Kind) -> Option<Item> {
        let mut state = self.state();
        let item = state.todo.pop_front_if(|item| item.kind() == kind);
        if item.is_some() {
            state.idle_since = Instant::now();
        }
        item
    }

    fn done(&self, _item: Item) {
        self.state().idle_since = Instant::now();
    }

    fn wait(&self, _kind: Kind, pause: Duration) -> bool {
        std::thread::sleep(pause);
        let mut state = self.state();
        state.helps = state.idle_since.elapsed() >= self.help_after;
        state.helps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: worker 1 of 3 of 7 views; then it helps with what is left.
    #[test]
    fn a_worker_does_its_share_and_then_what_others_left() {
        let share = Share::new(1, 3, Duration::ZERO);
        let views = |numbers: &[usize]| numbers.iter().map(|n| Item::View(*n)).collect::<Vec<_>>();
        let offer =
            |share: &Share, numbers: &[usize]| share.offer(&mut || Ok(views(numbers))).expect("offers");
        let taken = || std::iter::from_fn(|| share.take(Kind::View)).collect::<Vec<_>>();
        offer(&share, &[6, 5, 4, 3, 2, 1, 0]);
        assert!(share.take(Kind::Cell).is_none());
        assert_eq!(taken(), views(&[4, 1]));
        assert!(share.wait(Kind::View, Duration::ZERO));
        offer(&share, &[6, 3, 0]);
        assert_eq!(taken(), views(&[3, 0, 6]));
        let patient = Share::new(0, 2, Duration::from_secs(3600));
        offer(&patient, &[1]);
        assert!(!patient.wait(Kind::View, Duration::ZERO), "it waits for the other");
        assert!(patient.take(Kind::View).is_none());
    }
}
