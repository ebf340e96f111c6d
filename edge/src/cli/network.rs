//! Fetching with the real clock and network.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use crate::fetch::{self, Environment, FetchError, NetworkLimits, Progress};

use super::failure::Failure;

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

pub fn failure(error: FetchError) -> Failure {
    match error {
        FetchError::Cancelled => Failure::Interrupted(error.into()),
        error => Failure::Failed("fetch", error.into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Exit};

    #[test]
    fn stores_are_checked_when_they_are_read() {
        for address in ["http://base:7733", "https://base", "http://[::1]:7733/store/"] {
            assert_eq!(parse_store(address).as_deref(), Ok(address));
        }
        let flags: [&[&str]; 3] =
            [&["serve", "--follow"], &["fetch", "--from"], &["trust", "add", "--trust-first"]];
        for flag in flags {
            for wrong in
                ["", "ftp://x", "base:7733", "http://", "http://a@b", "http://a:70000", "http://a/?b"]
            {
                let line = [&["slag-edge"], flag, &[wrong]].concat();
                let error = Cli::try_parse_from(&line).expect_err(wrong);
                assert_eq!(error.exit_code(), Exit::Usage as i32, "{line:?}");
            }
        }
        assert!(parse_store("ftp://x").is_err_and(|what| what.contains("http:// or https://")));
    }
}
