//! The doors to other systems before a real robot, each driven by the other project's own software.

use super::*;

use slag_tests::*;

#[test]
fn the_library_of_the_mcap_project_reads_what_a_robot_said() {
    let python = python_with("doors/mcap/tests");
    let site = Site::new();
    let robot = site.robot(&["--follow", &site.store.url]);
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("said.mcap");
    let mut record = Command::new(program("slag-mcap"));
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

    // A robot that refuses leaves no file, and its reason is reported.
    let nothing = dir.path().join("nothing.mcap");
    let mut refused = Command::new(program("slag-mcap"));
    let output = refused.args(["--robot", &robot.url, "--text", ""]).arg(&nothing).output().expect("starts");
    assert!(!output.status.success() && !nothing.exists());
    assert!(String::from_utf8_lossy(&output.stderr).starts_with("slag-mcap: "), "{output:?}");
}

#[test]
fn the_client_of_the_mcp_project_asks_a_robot() {
    let python = python_with("doors/mcp/tests");
    let site = Site::new();
    site.publish_another();
    let robot = site.robot(&[]);
    let mcp = program("slag-mcp");
    let door = Service::start(Command::new(&mcp).args(["--robot", &robot.url]));
    let args = [text(&mcp), &robot.url, "red", &site.store.url, &door.url];
    let printed = judge(&python, "doors/mcp/tests/against_the_program.py", &args);
    assert!(printed.contains("stdio: ") && printed.contains("http: "), "{printed}");
}

#[test]
fn cyclone_dds_asks_a_robot() {
    let python = python_with("doors/ros/tests");
    let dir = tempfile::tempdir().expect("a temporary folder");
    let geo = dir.path().join("geo.json");
    fs_err::write(&geo, r#"{"origin": {"lat": 47.25, "lon": 8.5, "alt": 400}}"#).expect("writes");
    let site = Site::of(&ROOM, &[&SITE[..], &["--geo", text(&geo)]].concat());
    let robot = site.robot(&["--follow", &site.store.url]);
    // Separates concurrent runs of the tests.
    let domain = (50 + std::process::id() % 40).to_string();
    // The nightly checks build the node for Jazzy and set this.
    let distribution = std::env::var("SLAG_ROS_DISTRIBUTION").unwrap_or("humble".into());
    let node = program("slag-ros");
    let args = [text(&node), &robot.url, "red", &domain, &distribution];
    let printed = judge(&python, "doors/ros/tests/against_the_program.py", &args);
    assert!(printed.contains(" points, service, tf, odometry, fix, "), "{printed}");
}

/// Odometry turned and moved against the scene; six photos without landmarks of their own determine the transform.
#[nightly("encodes a room with landmarks")]
fn cyclone_dds_tells_a_robot_where_it_is() {
    let python = python_with("doors/ros/tests");
    let room = ["--n-views", "24", "--seed", "7"];
    let site = Site::of(&room, &["--models", "colours", "--locate"]);
    let robot = site.robot(&["--follow", &site.store.url]);
    let domain = (150 + std::process::id() % 40).to_string();
    let (node, photos) = (program("slag-ros"), generated(&room).join("test"));
    let args = [text(&node), &robot.url, text(&photos), &domain];
    let printed = judge(&python, "doors/ros/tests/against_locating.py", &args);
    assert!(printed.starts_with("6 photos, at most "), "{printed}");
}
