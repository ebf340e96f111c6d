//! What every fleet does, whatever its bucket is and however work is handed out.

use std::process::Command;

use serde_json::json;

use super::support::*;

/// A bucket, and a queue or shares.
pub trait Kind {
    fn scene(&self) -> &Scene;

    fn coordinator(&self, store: &str) -> Command;

    fn worker(&self, number: usize) -> Command;

    fn n_views(&self) -> usize;
}

/// The first of two workers is killed at its second view; the other does what is left, and no view is done twice.
pub fn conforms(kind: &dyn Kind) {
    let coordinator = Running::start(&mut kind.coordinator("store"));
    let killed = Running::start(&mut kind.worker(0));
    wait_until("a first view", || kind.n_views() > 0);
    killed.kill();
    let n_of_killed = kind.n_views();
    assert!(n_of_killed < N_VIEWS, "it was killed too late");
    let report = Running::start(&mut kind.worker(1)).json();
    let summary = coordinator.json();
    assert_eq!((&summary["n_views"], &summary["skipped_views"]), (&N_VIEWS.into(), &json!([])));
    assert_eq!(report["n_views"], N_VIEWS - n_of_killed, "{report}");
    kind.scene().assert_same("store");
    // What the bucket has is not done again, whoever asks for it: there is no worker.
    Running::start(&mut kind.coordinator("again")).json();
    kind.scene().assert_same("again");
}
