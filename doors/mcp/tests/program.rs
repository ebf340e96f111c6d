//! The real program in front of a real robot, driven by the MCP project's own client.

use std::path::Path;
use std::process::Command;

use slag_tests::*;

#[test]
fn the_client_of_the_mcp_project_asks_a_robot() {
    let python = python_with("doors/mcp/tests");
    let site = Site::new();
    site.publish_another();
    let robot = site.robot(&[]);
    let mcp = Path::new(env!("CARGO_BIN_EXE_slag-mcp"));
    let door = Service::start(Command::new(mcp).args(["--robot", &robot.url]));
    let args = [text(mcp), &robot.url, "red", &door.url];
    let printed = judge(&python, "doors/mcp/tests/against_the_program.py", &args);
    assert!(printed.contains("stdio: ") && printed.contains("http: "), "{printed}");
}
