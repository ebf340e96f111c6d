//! The interface of what gives a worker its work.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::error::FleetError;

/// A view by its number in the plan, or a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Item {
    View(usize),
    Cell(u32),
}

/// A kind of work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    View,
    Cell,
}

impl Item {
    pub(super) fn kind(self) -> Kind {
        match self {
            Self::View(_) => Kind::View,
            Self::Cell(_) => Kind::Cell,
        }
    }
}

/// Returns the items that are not done, in the order in which they should be begun.
pub(super) type OpenItems<'a> = &'a mut dyn FnMut() -> Result<Vec<Item>, FleetError>;

/// Gives a worker its work.
pub(super) trait Dispatcher: Sync {
    /// Called before items are taken, and again where [`Dispatcher::wait`] says so.
    ///
    /// # Errors
    /// Those of `open`.
    fn offer(&self, open: OpenItems<'_>) -> Result<(), FleetError>;

    /// Returns the next item of a kind, without waiting; `None` if there is none at present.
    fn take(&self, kind: Kind) -> Option<Item>;

    /// Says that the item's result, or its failure, is in the bucket.
    fn done(&self, item: Item);

    /// Waits at most `pause` for an item of a kind; returns whether there may be one.
    fn wait(&self, kind: Kind, pause: Duration) -> bool;

    /// Returns the items that were given to workers too often, each time without a result.
    fn take_dead(&self) -> Vec<Item> {
        Vec::new()
    }
}
