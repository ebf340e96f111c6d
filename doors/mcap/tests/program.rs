//! The real program in front of a real robot; its file is read by the MCAP project's own library.

use std::process::Command;

use slag_tests::*;

#[test]
fn the_library_of_the_mcap_project_reads_what_a_robot_said() {
    let python = python_with("doors/mcap/tests");
    let site = Site::new();
    let robot = site.robot(&["--follow", &site.store.url]);
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("said.mcap");
    let mut record = Command::new(env!("CARGO_BIN_EXE_slag-mcap"));
    record.args([
        "--robot",
        &robot.url,
        "--text",
        "red",
        "--text",
        "largest blue",
        "--points",
        "50",
        "--ground",
    ]);
    run(record.arg(&file));
    let printed = judge(&python, "doors/mcap/tests/against_the_file.py", &[text(&file), &robot.url]);
    assert!(printed.contains("things, points, ground"), "{printed}");

    // A robot that refuses leaves no file, and its reason is told.
    let nothing = dir.path().join("nothing.mcap");
    let mut refused = Command::new(env!("CARGO_BIN_EXE_slag-mcap"));
    let output = refused.args(["--robot", &robot.url, "--text", ""]).arg(&nothing).output().expect("starts");
    assert!(!output.status.success() && !nothing.exists());
    assert!(String::from_utf8_lossy(&output.stderr).starts_with("slag-mcap: "), "{output:?}");
}
