//! Progress of long work. The library itself never prints.

/// Receives the progress of one run. Stages follow one another.
pub trait Progress: Sync {
    /// Begins a stage of `total` steps, each a `unit`; an earlier run has done `done` of them.
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64);
    /// Counts `n` more steps as done.
    fn advance(&self, n: u64);
    /// Ends the stage.
    fn end(&self);
}

/// Discards progress events.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &str, _: &str, _: u64, _: u64) {}
    fn advance(&self, _: u64) {}
    fn end(&self) {}
}
