//! The surroundings of a fetch: clock, cancel flag, random numbers, progress and network limits.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::error::DownloadFailure;
use super::limits::NetworkLimits;

/// Receives the progress of a fetch, from any of its threads.
pub trait Progress: Sync {
    /// Called once with the number and total length of the shards to download.
    fn planned(&self, _n_shards: usize, _bytes: u64) {}
    /// Called with the number of bytes received since the last call.
    fn received(&self, _bytes: u64) {}
    /// Called when an attempt failed and another follows.
    fn retried(&self, _url: &str, _failure: &DownloadFailure) {}
}

impl Progress for () {}

/// The surroundings of a fetch.
pub struct Environment<'a> {
    /// The current time, seconds since 1970.
    pub now_unix_secs: u64,
    /// Set to end the fetch; the next one resumes what arrived.
    pub cancel: &'a AtomicBool,
    /// Receives the progress.
    pub progress: &'a dyn Progress,
    /// Returns numbers within 0..1, to spread retries.
    pub random: &'a (dyn Fn() -> f64 + Sync),
    /// Certificates (PEM) of the authorities that may vouch for `https://` addresses; absent: those that browsers trust.
    pub ca: Option<&'a Path>,
    /// Network timeouts and retry limits.
    pub limits: NetworkLimits,
}
