//! Workers with shares, and a folder as bucket.

use super::support::*;
use slag_tests::*;

/// The first of two workers is killed at its second view, so the other does what is left of its share.
#[test]
fn a_folder_and_two_workers_of_which_one_is_killed_give_the_same_bytes() {
    let scene = Scene::new();
    let (bucket, scratch) = (scene.path("bucket"), scene.path("scratch"));
    let share = |index: &str| {
        let mut worker = worker(text(&bucket));
        worker.args(["--scratch", text(&scratch)]);
        worker.args(["--index", index, "--of", "2", "--help-after", "0.2", "--threads", "1"]);
        worker
    };
    let coordinator = Running::start(scene.encode("store").args(["--blobs", text(&bucket)]));
    let killed = Running::start(&mut share("0"));
    wait_until("a first view", || n_objects(&bucket.join("views")) > 0);
    killed.kill();
    let n_of_killed = n_objects(&bucket.join("views"));
    assert_eq!(n_objects(&scratch), 1, "a worker that is killed leaves its folder");
    assert!(n_of_killed < N_VIEWS / 2, "it was killed too late");

    // Another image model makes other vectors.
    let mut other =
        encoder(&["worker", "--blobs", text(&bucket), "--index", "1", "--of", "2", "--device", "cpu"]);
    let refused = worker_output(&mut other);
    assert!(refused.contains("colours") && refused.contains("--models"), "{refused}");

    let mut interrupted = Running::start(&mut share("1"));
    let own = format!("slag-worker-{}-", interrupted.id());
    wait_until("a folder of the next worker alone, without that of the killed one", || {
        let folders = std::fs::read_dir(&scratch).expect("there").flatten();
        let names: Vec<_> = folders.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
        matches!(&names[..], [name] if name.starts_with(&own))
    });
    interrupted.signal("TERM");
    assert_eq!(interrupted.output().status.code(), Some(130));
    assert_eq!(n_objects(&scratch), 0, "a worker that is interrupted takes its folder with it");

    let n_before = n_objects(&bucket.join("views"));
    let report = Running::start(&mut share("1")).json();
    let summary = coordinator.json();
    assert_eq!(n_objects(&scratch), 0);
    assert_eq!(summary["n_views"], N_VIEWS);
    assert_eq!(report["n_views"], N_VIEWS - n_before, "{report}");
    scene.assert_same("store");

    // What the bucket has is not done again, whoever asks for it: there is no worker.
    Running::start(scene.encode("again").args(["--blobs", text(&bucket)])).json();
    scene.assert_same("again");

    // A program of another version does not touch a run.
    let plan = bucket.join("jobs/00000009/plan.json");
    fs_err::create_dir_all(plan.parent().expect("a folder")).expect("made");
    fs_err::write(plan, r#"{"program": "7.0.0"}"#).expect("written");
    let refused = worker_output(&mut share("0"));
    assert!(refused.contains("7.0.0") && refused.contains("install the same program"), "{refused}");
}

/// Returns what a worker that must fail prints.
fn worker_output(command: &mut std::process::Command) -> String {
    let output = command.output().expect("starts");
    assert_eq!(output.status.code(), Some(1), "{command:?}");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}
