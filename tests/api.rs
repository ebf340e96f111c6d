//! The robot's API as programs use it: the Python client against the real programs.

use std::path::Path;

use slag_tests::*;

#[test]
fn the_python_client_asks_a_robot() {
    judge(Path::new("python3"), "clients/python/tests/without_a_robot.py", &[]);
    let site = Site::new();
    let robot = site.robot(&[]);
    let printed =
        judge(Path::new("python3"), "clients/python/tests/against_the_program.py", &[&robot.url, "red"]);
    assert!(printed.contains(" things, "), "{printed}");
}
