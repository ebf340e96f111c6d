//! The real program in front of a real robot, driven by Cyclone DDS.

use slag_tests::*;

#[test]
fn cyclone_dds_asks_a_robot() {
    let python = python_with("doors/ros/tests");
    let site = Site::new();
    let robot = site.robot(&["--follow", &site.store.url]);
    // Runs of the tests at the same time do not hear each other.
    let domain = (50 + std::process::id() % 40).to_string();
    let distribution = if cfg!(feature = "jazzy") { "jazzy" } else { "humble" };
    let args = [env!("CARGO_BIN_EXE_slag-ros"), &robot.url, "red", &domain, distribution];
    let printed = judge(&python, "doors/ros/tests/against_the_program.py", &args);
    assert!(printed.contains(" points, service, tf, odometry, fix, "), "{printed}");
}
