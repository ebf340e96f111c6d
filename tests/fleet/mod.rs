//! Fleets of real workers against the bytes that one process makes.

mod conformance;
mod faults;
mod folder;
mod nats;
mod network;
#[cfg(feature = "nightly")]
mod s3;
mod secured;
mod support;
