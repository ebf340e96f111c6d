//! Fetching with the real clock and network.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use crate::fetch::{self, Environment, NetworkLimits, Progress};

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

/// Parses a store's address, so that a wrong one is refused before anything starts.
pub fn parse_store(text: &str) -> Result<String, String> {
    let address = fetch::check_address(text).map(|()| text.to_owned());
    address.map_err(|what| format!("{what}; give an address like http://host:port"))
}

/// Returns a number in 0..1 that differs between robots, so that a fleet does not retry in step.
pub fn random() -> f64 {
    // The standard library's random hash keys are new for each call.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}
