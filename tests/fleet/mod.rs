//! Fleets of real workers give the bytes of a single process.

mod conformance;
mod faults;
mod folder;
mod nats;
mod network;
#[cfg(feature = "nightly")]
mod s3;
mod secured;
mod support;

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use slag_math::random::Random;

use conformance::conforms;
use network::Network;
