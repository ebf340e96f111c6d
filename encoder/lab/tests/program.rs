//! The program as a user meets it. Cargo builds a package's programs before its integration tests: the end-to-end
//! tests in `tests/` run this one.

use std::process::{Command, Output};

fn lab(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_slag-lab")).args(args).output().expect("the program starts")
}

/// Without the feature `measure` there is no `eval` and no `bench`.
#[test]
#[cfg(feature = "measure")]
fn help_names_every_job() {
    let output = lab(&["--help"]);
    let help = String::from_utf8(output.stdout).expect("UTF-8");
    assert!(output.status.success());
    for job in ["generate", "eval", "bench", "demo"] {
        assert!(help.contains(&format!("\n  {job}")), "{job}: {help}");
    }
}

/// Wrong usage is told on stderr, with exit code 2, and nothing is printed as a result.
#[test]
fn an_unknown_command_is_refused() {
    let output = lab(&["evaluate"]);
    assert_eq!((output.status.code(), output.stdout.len()), (Some(2), 0));
    assert!(String::from_utf8_lossy(&output.stderr).contains("evaluate"));
}
