//! How long work tells how far it is; the library itself never prints.

/// Hears of the progress of one run. Stages follow one another.
pub trait Progress: Sync {
    /// A stage begins: `total` steps of `unit` lie ahead, `done` of them were done in an earlier run.
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64);
    /// `n` more steps are done.
    fn advance(&self, n: u64);
    /// The stage is over.
    fn end(&self);
}

/// Hears nothing.
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _: &str, _: &str, _: u64, _: u64) {}
    fn advance(&self, _: u64) {}
    fn end(&self) {}
}
