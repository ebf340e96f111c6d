//! The program as a user meets it. Cargo builds a package's programs before its integration tests: the end-to-end
//! tests in `tests/` run this one.

use std::process::Command;

/// Wrong usage is told on stderr, with exit code 2, and nothing is printed as a result.
#[test]
fn an_unknown_command_is_refused() {
    let lab = Command::new(env!("CARGO_BIN_EXE_slag-lab")).arg("evaluate").output();
    let output = lab.expect("the program starts");
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0));
    assert!(String::from_utf8_lossy(&output.stderr).contains("evaluate"));
}
