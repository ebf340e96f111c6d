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
