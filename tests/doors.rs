//! The doors, driven by clients of other projects: the real programs in front of a real robot.

use std::path::{Path, PathBuf};
use std::process::Command;

use slag_tests::*;

/// A store of a generated room, and a robot that fetched from it and knows things by their colours.
struct World {
    store: Service,
    dir: tempfile::TempDir,
}

impl World {
    fn make() -> Self {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let (room, store, cache) =
            (dir.path().join("room"), dir.path().join("store"), dir.path().join("cache"));
        run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "12"]));
        run(encode_room(&room, &store).args(["--models", "colours"]));
        let store = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
        run(edge(&["fetch", "--trust-first", "--from", &store.url, "--at", "3.5,2.7,0"])
            .args(["--cache", text(&cache)]));
        Self { store, dir }
    }

    /// Starts the robot, which follows positions.
    fn robot(&self) -> Service {
        let cache = self.dir.path().join("cache");
        let mut serve = edge(&["serve", "--models", "colours", "--cache", text(&cache)]);
        Service::start(serve.args(["--follow", &self.store.url]))
    }
}

/// Returns the Python of an environment with a door's requirements, or `None` where there is no Python or no registry.
///
/// Kept beside the built programs, and made anew when the requirements change.
fn python_with(door: &str) -> Option<PathBuf> {
    let requirements = root().join(format!("doors/{door}/tests/requirements.txt"));
    let wanted = fs_err::read_to_string(&requirements).expect("requirements");
    let folder = program("slag-edge").parent()?.join(format!("python-{door}"));
    let (python, made_for) = (folder.join("bin/python"), folder.join("made-for"));
    if std::fs::read_to_string(&made_for).is_ok_and(|found| found == wanted) {
        return Some(python);
    }
    let succeeds = |command: &mut Command| command.output().is_ok_and(|output| output.status.success());
    let install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--requirement"];
    let is_made = succeeds(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&folder))
        && succeeds(Command::new(&python).args(install).arg(&requirements));
    if !is_made {
        eprintln!("skipped: no Python environment with {}", wanted.trim().replace('\n', ", "));
        return None;
    }
    fs_err::write(&made_for, wanted).expect("written");
    Some(python)
}

/// Runs a door's judge, which prints what it saw.
fn judge(python: &Path, script: &str, args: &[&str]) -> String {
    let script = root().join("doors").join(script);
    let judged = run(Command::new(python).arg(&script).args(args).env("PYTHONDONTWRITEBYTECODE", "1"));
    String::from_utf8_lossy(&judged.stdout).into_owned()
}

#[test]
fn the_client_of_the_mcp_project_asks_a_robot() {
    let Some(python) = python_with("mcp") else { return };
    let world = World::make();
    let robot = world.robot();
    let mcp = program("slag-mcp");
    let door = Service::start(Command::new(&mcp).args(["--robot", &robot.url]));
    let said =
        judge(&python, "mcp/tests/against_the_program.py", &[text(&mcp), &robot.url, "red", &door.url]);
    assert!(said.contains("stdio: ") && said.contains("http: "), "{said}");
}

#[test]
fn cyclone_dds_asks_a_robot() {
    let Some(python) = python_with("ros") else { return };
    let world = World::make();
    let robot = world.robot();
    let ros = program("slag-ros");
    // Runs of the tests at the same time do not hear each other.
    let domain = (50 + std::process::id() % 40).to_string();
    let said = judge(&python, "ros/tests/against_the_program.py", &[text(&ros), &robot.url, "red", &domain]);
    assert!(said.contains(" points, service, tf, odometry, fix"), "{said}");
}
