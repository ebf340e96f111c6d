//! Clients of other projects as Python packages: an environment for each list of requirements.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, PoisonError};

use crate::{program, root, run};

/// Returns the Python of an environment with the packages of `FOLDER/requirements.txt`.
///
/// The environment lies beside the built programs and is rebuilt when the requirements change.
///
/// # Panics
/// If it cannot be made; `scripts/setup.sh` installs Python and its `venv`.
pub fn python_with(folder: &str) -> PathBuf {
    // Tests of one program ask at once.
    static MAKING: Mutex<()> = Mutex::new(());
    let _alone = MAKING.lock().unwrap_or_else(PoisonError::into_inner);
    let requirements = root().join(folder).join("requirements.txt");
    let wanted = fs_err::read_to_string(&requirements).expect("requirements");
    let programs = program("slag-edge");
    let environment = programs.with_file_name(format!("python-{}", folder.replace('/', "-")));
    let (python, made_for) = (environment.join("bin/python"), environment.join("made-for"));
    if std::fs::read_to_string(&made_for).is_ok_and(|found| found == wanted) {
        return python;
    }
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&environment));
    let install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--requirement"];
    run(Command::new(&python).args(install).arg(&requirements));
    fs_err::write(&made_for, wanted).expect("written");
    python
}

/// Runs a Python script, which fails if a program is wrong; returns its output.
pub fn judge(python: &Path, script: &str, args: &[&str]) -> String {
    let judged =
        run(Command::new(python).arg(root().join(script)).args(args).env("PYTHONDONTWRITEBYTECODE", "1"));
    String::from_utf8_lossy(&judged.stdout).into_owned()
}
