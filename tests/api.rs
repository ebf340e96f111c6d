//! The robot's API as programs use it: the Python client against the real programs.

use std::process::Command;

use slag_tests::*;

/// Returns a Python, or `None` on a machine without one.
fn python() -> Option<&'static str> {
    let works = |name: &&str| Command::new(name).arg("--version").output().is_ok_and(|o| o.status.success());
    ["python3", "python"].into_iter().find(works)
}

#[test]
fn the_python_client_asks_a_robot() {
    let Some(python) = python() else {
        eprintln!("skipped: there is no python3");
        return;
    };
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (room, store, cache) = (dir.path().join("room"), dir.path().join("store"), dir.path().join("cache"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "12"]));
    run(encode_room(&room, &store).args(["--models", "colours"]));
    let server = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    run(edge(&["fetch", "--trust-first", "--from", &server.url, "--at", "3.5,2.7,0"])
        .args(["--cache", text(&cache)]));
    let robot = Service::start(&mut edge(&["serve", "--models", "colours", "--cache", text(&cache)]));
    let test = root().join("clients/python/tests/against_the_program.py");
    let asked = run(Command::new(python).args([text(&test), &robot.url, "red"]));
    let said = String::from_utf8_lossy(&asked.stdout).into_owned();
    assert!(said.contains(" things, "), "{said}");
}
