//! Workers with shares, and a folder as bucket.

use super::*;

use super::support::*;
use slag_tests::*;

#[test]
fn a_folder_and_shares_conform() {
    let scene = Scene::new();
    let bucket = text(&scene.path("bucket")).to_owned();
    let coordinator = |store: &str| {
        let mut command = scene.encode(store);
        command.args(["--blobs", &bucket]);
        command
    };
    let n_views = || n_objects(&scene.path("bucket/views"));
    conforms(&scene, coordinator, |number| with_share(worker(&bucket), number), n_views);
}

/// Temporary folders of photos are removed with their workers, or when the next one begins; workers of other
/// models and versions are refused.
#[test]
fn workers_leave_nothing_and_do_not_mix() {
    let scene = Scene::new();
    let (bucket, scratch) = (scene.path("bucket"), scene.path("scratch"));
    let share = |number: usize| {
        let mut worker = with_share(worker(text(&bucket)), number);
        worker.args(["--scratch", text(&scratch)]);
        worker
    };
    let coordinator = Running::start(scene.encode("store").args(["--blobs", text(&bucket)]));
    let killed = Running::start(&mut share(0));
    wait_until("a first view", || n_objects(&bucket.join("views")) > 0);
    killed.kill();
    let n_of_killed = n_objects(&bucket.join("views"));
    assert_eq!(n_objects(&scratch), 1, "a worker that is killed leaves its folder");
    assert!(n_of_killed < N_VIEWS / 2, "it was killed too late");

    // Another image model gives other vectors.
    let mut other =
        encoder(&["worker", "--blobs", text(&bucket), "--index", "1", "--of", "2", "--device", "cpu"]);
    let refused = worker_output(&mut other);
    assert!(refused.contains("colours") && refused.contains("--models"), "{refused}");

    let mut interrupted = Running::start(&mut share(1));
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
    let report = Running::start(&mut share(1)).json();
    let summary = coordinator.json();
    assert_eq!(n_objects(&scratch), 0);
    assert_eq!(summary["n_views"], N_VIEWS);
    assert_eq!(report["n_views"], N_VIEWS - n_before, "{report}");
    scene.assert_same("store");

    // A program of another version does not touch a run.
    let plan = bucket.join("jobs/00000009/plan.json");
    fs_err::create_dir_all(plan.parent().expect("a folder")).expect("made");
    fs_err::write(plan, r#"{"program": "7.0.0"}"#).expect("written");
    let refused = worker_output(&mut share(0));
    assert!(refused.contains("7.0.0") && refused.contains("install the same program"), "{refused}");
}

fn worker_output(command: &mut Command) -> String {
    let output = command.output().expect("starts");
    assert_eq!(output.status.code(), Some(1), "{command:?}");
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}
