//! Fetching with the real clock and network, and with the keys given on the command line.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::sync::atomic::AtomicBool;

use anyhow::anyhow;
use slag_common::Hash32;
use slag_edge::fetch::{self, Environment, FetchError, FetchReport, FetchRequest, NetworkLimits, Progress};
use slag_edge::store::EdgeCache;

use super::failure::Failure;

/// A second key is an announced successor; more are a mistake.
const MAX_KEYS: usize = 2;

/// Checks the number of keys given.
pub fn checked_keys(keys: Vec<Hash32>) -> Result<Vec<Hash32>, Failure> {
    match keys.len() {
        0..=MAX_KEYS => Ok(keys),
        n => Err(Failure::Usage(anyhow!("--key is given {n} times, the limit is {MAX_KEYS}"))),
    }
}

/// Fetches once.
pub fn fetch_once(
    cache: &EdgeCache,
    request: &FetchRequest,
    cancel: &AtomicBool,
    progress: &dyn Progress,
) -> Result<FetchReport, FetchError> {
    let environment = Environment {
        now_unix_secs: slag_edge::now_unix_secs(),
        cancel,
        progress,
        random: &random,
        limits: NetworkLimits::default(),
    };
    fetch::fetch(cache, request, &environment)
}

/// Returns a number in 0..1 that differs from robot to robot, so that a fleet does not retry in step.
pub fn random() -> f64 {
    // The standard library's random hash keys are new for each call.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}

/// Wraps the error of a fetch.
pub fn failure(error: FetchError) -> Failure {
    match error {
        FetchError::Cancelled => Failure::Interrupted(error.into()),
        error => Failure::Failed("fetch", error.into()),
    }
}
