//! The workspace's version: programs, packages, descriptions and clients state the same.

use super::*;
use std::io::{BufRead, BufReader, Write};

use slag_tests::*;

const VERSION: &str = env!("CARGO_PKG_VERSION");

#[test]
fn programs_state_the_version_of_the_workspace() {
    for name in ["slag-encoder", "slag-edge", "slag-lab", "slag-mcap", "slag-mcp", "slag-ros"] {
        let stated = run(Command::new(program(name)).arg("--version")).stdout;
        assert_eq!(String::from_utf8_lossy(&stated).trim(), format!("{name} {VERSION}"));
    }
    // Packages and images take it from there.
    let stated = run(Command::new("sh").arg(root().join("scripts/version.sh"))).stdout;
    assert_eq!(String::from_utf8_lossy(&stated).trim(), VERSION);
}

#[test]
fn descriptions_and_clients_state_the_version_of_the_workspace() {
    let site = Site::new();
    for service in [&site.store, &site.robot(&[])] {
        assert_eq!(service.get("/openapi.json")["info"]["version"], VERSION);
    }
    for (file, line) in [
        ("clients/python/pyproject.toml", format!("version = \"{VERSION}\"")),
        ("doors/ros/slag_msgs/package.xml", format!("<version>{VERSION}</version>")),
        ("common/view/web/package.json", format!("\"version\": \"{VERSION}\",")),
        ("encoder/deploy/kubernetes.yaml", format!("image: registry.example/slag-encoder:{VERSION}")),
    ] {
        let text = fs_err::read_to_string(root().join(file)).expect("there");
        assert!(text.lines().any(|found| found.trim() == line), "{file} does not say {line}");
    }
}

#[test]
fn the_door_for_language_models_states_the_version_of_the_workspace() {
    let mut door = Command::new(program("slag-mcp"));
    let mut door = door.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("starts");
    let params = json!({"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}});
    let hello = json!({"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": params});
    writeln!(door.stdin.as_mut().expect("piped"), "{hello}").expect("written");
    let mut line = String::new();
    BufReader::new(door.stdout.as_mut().expect("piped")).read_line(&mut line).expect("answers");
    door.kill().expect("killed");
    door.wait().expect("ends");
    let answer: Value = serde_json::from_str(&line).expect("JSON");
    assert_eq!(answer["result"]["serverInfo"]["version"], VERSION, "{answer}");
}
