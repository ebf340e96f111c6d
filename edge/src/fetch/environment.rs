//! What a fetch takes from outside: the clock, the cancel flag, chance, and who is told of progress.

use std::sync::atomic::AtomicBool;

use super::error::DownloadFailure;
use super::limits::NetworkLimits;

/// Is told how a fetch goes on, from any of its threads.
pub trait Progress: Sync {
    /// So many shards of so many bytes in all are to be downloaded.
    fn planned(&self, _n_shards: usize, _bytes: u64) {}
    /// So many bytes came in.
    fn received(&self, _bytes: u64) {}
    /// An attempt failed; another one follows.
    fn retried(&self, _url: &str, _failure: &DownloadFailure) {}
}

impl Progress for () {}

/// What a fetch takes from outside.
pub struct Environment<'a> {
    /// The clock, seconds since 1970.
    pub now_unix_secs: u64,
    /// Set by anyone who wants the fetch to end; what came in so far is resumed by the next one.
    pub cancel: &'a AtomicBool,
    /// Is told how it goes on.
    pub progress: &'a dyn Progress,
    /// Gives numbers within 0..1, to spread retries.
    pub random: &'a (dyn Fn() -> f64 + Sync),
    /// Patience with the network.
    pub limits: NetworkLimits,
}
