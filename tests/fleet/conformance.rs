//! Behaviour of every fleet, for any bucket and any distribution of work.

use super::*;

use serde_json::json;

use super::support::*;

/// The first of two workers is killed at its second view; the other does the rest, and no view is done twice.
/// `coordinator`: by its store; `worker`: by its number; `n_views`: those in the bucket.
pub fn conforms(
    scene: &Scene,
    coordinator: impl Fn(&str) -> Command,
    worker: impl Fn(usize) -> Command,
    n_views: impl Fn() -> usize,
) {
    let coordinating = Running::start(&mut coordinator("store"));
    let killed = Running::start(&mut worker(0));
    wait_until("a first view", || n_views() > 0);
    killed.kill();
    let n_of_killed = n_views();
    assert!(n_of_killed < N_VIEWS, "it was killed too late");
    let report = Running::start(&mut worker(1)).json();
    let summary = coordinating.json();
    assert_eq!((&summary["n_views"], &summary["skipped_views"]), (&N_VIEWS.into(), &json!([])));
    assert_eq!(report["n_views"], N_VIEWS - n_of_killed, "{report}");
    scene.assert_same("store");
    // What the bucket has is not done again: there is no worker.
    Running::start(&mut coordinator("again")).json();
    scene.assert_same("again");
}
