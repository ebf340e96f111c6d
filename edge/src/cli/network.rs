//! Fetching with the real clock and network.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use crate::fetch::{Environment, FetchError, NetworkLimits, Progress};

use super::failure::Failure;

/// Returns the real surroundings.
pub fn environment<'a>(
    ca: Option<&'a Path>,
    cancel: &'a AtomicBool,
    progress: &'a dyn Progress,
) -> Environment<'a> {
    Environment {
        now_unix_secs: crate::now_unix_secs(),
        cancel,
        progress,
        random: &random,
        ca,
        limits: NetworkLimits::default(),
    }
}

/// Returns a number in 0..1 that differs from robot to robot, so that a fleet does not retry in step.
pub fn random() -> f64 {
    // The standard library's random hash keys are new for each call.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}

pub fn failure(error: FetchError) -> Failure {
    match error {
        FetchError::Cancelled => Failure::Interrupted(error.into()),
        error => Failure::Failed("fetch", error.into()),
    }
}
