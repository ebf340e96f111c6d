//! The APIs as programs use them: the Python client, and both services against their descriptions.

use super::*;

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

/// Schemathesis sends valid and invalid requests from `/openapi.json` and checks status, type and schema of every
/// answer. `names`: values for the configuration; `excluded`: operations that never end.
fn conforms(service: &Service, names: &[(&str, &str)], excluded: &[&str]) {
    let python = python_with("tests/schemathesis");
    let mut command = Command::new(python.with_file_name("schemathesis"));
    // It writes reports to the working folder.
    let dir = tempfile::tempdir().expect("a temporary folder");
    command.current_dir(dir.path());
    command.arg("--config-file").arg(root().join("tests/schemathesis/schemathesis.toml"));
    // One thread: some Pythons fail when two threads parse Python (issue 106905).
    command.args(["--no-color", "run", "--checks", "all", "--workers", "1", "--continue-on-failure"]);
    command.args(excluded.iter().flat_map(|path| ["--exclude-path", path]));
    command.envs(names.iter().copied());
    let printed = run(command.arg(format!("{}/openapi.json", service.url))).stdout;
    let printed = String::from_utf8_lossy(&printed);
    assert!(printed.contains("Coverage") && printed.contains(" passed"), "{printed}");
}

#[test]
fn both_services_are_as_they_describe_themselves() {
    let site = Site::new();
    let manifest = site.store.get("/v1/manifest");
    let hash = manifest["cells"][0]["shards"]["compact"]["hash"].as_str().expect("a shard");
    let targets = site.store.get("/v1/metadata/1.targets.json");
    let sha256 = targets["signed"]["targets"]["manifest"]["hashes"]["sha256"].as_str().expect("a target");
    let names = [("SLAG_HASH", hash), ("SLAG_TARGET", &format!("{sha256}.manifest"))];
    conforms(&site.store, &names, &[]);
    // Events are sent as long as the client listens.
    conforms(&site.robot(&[]), &names, &["/v1/events"]);
}
