//! A store that carries the text side of its encoder: robots fetch it with the scene and need no models of their own.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;
use slag_tests::*;

/// What a robot asks: the nearest Gaussians whatever their scores, so that equal vectors give equal answers.
const QUESTION: [&str; 6] = ["query", "chair", "--kind", "gaussians", "--threshold=-1", "--json"];

/// A folder of models that no program has built in: the embedded ones, whose texts get another prompt.
fn models(folder: &Path, licence: &str) -> PathBuf {
    let embedded = root().join("common/models/embedded");
    fs_err::create_dir_all(folder).expect("made");
    for name in ["image.onnx", "text.onnx", "tokenizer.json"] {
        fs_err::copy(embedded.join(name), folder.join(name)).expect("copied");
    }
    let description = fs_err::read_to_string(embedded.join("model.toml")).expect("there");
    let changed = description.replace("prompt = \"{}\"", "prompt = \"a {}\"");
    assert_ne!(changed, description);
    let head = description.lines().find(|line| line.starts_with("licence = ")).expect("a licence");
    fs_err::write(folder.join("model.toml"), changed.replace(head, &format!("licence = {licence:?}")))
        .expect("written");
    folder.to_owned()
}

fn fetch(from: &str, cache: &Path) -> Command {
    let mut command =
        edge(&["fetch", "--trust-first", "--from", from, "--at", "3.5,2.7,0", "--cache", text(cache)]);
    command.arg("--json");
    command
}

fn json(command: &mut Command) -> Value {
    serde_json::from_slice(&run(command).stdout).expect("JSON")
}

/// Asks a robot without `--models`.
fn ask(cache: &Path) -> Value {
    json(edge(&QUESTION).args(["--cache", text(cache)]))["answers"].clone()
}

/// Flips a bit in the middle of a file.
fn flip(path: &Path) {
    let mut bytes = fs_err::read(path).expect("there");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs_err::write(path, bytes).expect("written");
}

/// Oracle: the answers with `--models`.
#[test]
fn robots_fetch_the_text_model_with_the_scene() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let at = |name: &str| dir.path().join(name);
    let (room, store, site) = (at("room"), at("store"), at("site"));
    run(&mut lab(&["generate", "scene", "--out", text(&room), "--n-views", "2"]));
    let encode = |models: &Path, store: &Path, flags: &[&str]| {
        let mut command = encode_room(&room, store);
        command
            .args(["--masks", "graph", "--device", "cpu", "--keep-views", "--models", text(models)])
            .args(flags);
        command
    };
    // A licence that forbids it is named before the work.
    let restricted = models(&at("restricted"), "apple-amlr");
    let refused = encode(&restricted, &at("refused"), &["--text-model"]).output().expect("starts");
    let message = String::from_utf8_lossy(&refused.stdout).into_owned();
    assert!(!refused.status.success() && message.contains("apple-amlr"), "{message}");
    assert!(!at("refused").join("manifest").exists());

    let models = models(&at("models"), "Apache-2.0 OR MIT");
    run(&mut encode(&models, &store, &[]));
    let plain = content(&store);
    assert!(!fs_err::read_to_string(store.join("manifest")).expect("there").contains("text_model"));
    run(&mut encode(&models, &store, &["--text-model"]));
    assert_eq!(content(&store), plain, "the shards do not depend on it");
    let manifest: Value =
        serde_json::from_slice(&fs_err::read(store.join("manifest")).expect("there")).expect("JSON");
    let carried = &manifest["encoder"]["text_model"];
    let files = carried["files"].as_array().expect("files");
    let len = |name: &str| fs_err::metadata(models.join(name)).expect("there").len();
    let lens: Vec<u64> = files.iter().filter_map(|file| file["len_bytes"].as_u64()).collect();
    assert_eq!(lens, [len("text.onnx"), len("tokenizer.json")]);
    let total = lens.iter().sum::<u64>() + carried["description"]["len_bytes"].as_u64().expect("a length");

    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let with_models = at("with_models");
    json(&mut fetch(&service.url, &with_models));
    let expected =
        json(edge(&QUESTION).args(["--cache", text(&with_models), "--models", text(&models)]))["answers"]
            .clone();
    assert!(expected.as_array().is_some_and(|answers| !answers.is_empty()), "{expected}");
    // The next generation has the same text model.
    run(&mut encode(&models, &store, &["--text-model", "--compact-error", "0.4"]));
    fs_err::remove_dir_all(&models).expect("removed");
    assert_eq!(ask(&with_models), expected);

    // Over the service. The robot was started with nothing on board.
    let served = at("served");
    let robot = Service::start(&mut edge(&["serve", "--cache", text(&served)]));
    let report = json(&mut fetch(&service.url, &served));
    assert_eq!(
        (&report["text_model"]["bytes"], &report["text_model"]["downloaded_bytes"]),
        (&total.into(), &total.into())
    );
    // It loads in the background.
    let is_ready = |_| {
        std::thread::sleep(Duration::from_millis(100));
        ureq::get(format!("{}/readyz", robot.url)).call().is_ok()
    };
    assert!((0..300).any(is_ready), "the robot does not take the scene with its text model");
    let answers = robot.get("/query?text=chair&kind=gaussians&threshold=-1");
    assert_eq!(answers["answers"], ask(&served), "{answers}");
    // A robot that has the generation before it brings shards only.
    let report = json(&mut fetch(&service.url, &with_models));
    assert_eq!(
        (&report["generation"], &report["text_model"]["downloaded_bytes"]),
        (&3.into(), &0.into()),
        "{report}"
    );
    assert_eq!(ask(&with_models), ask(&served));

    // What the store needs no more goes; the text model stays.
    run_json(&mut encoder(&["store", "gc", "--store", text(&store)]));
    assert_eq!(
        run_json(&mut encoder(&["store", "verify", "--store", text(&store)]))["bad"],
        serde_json::json!([])
    );

    // Over static files.
    run_json(&mut encoder(&["store", "export", "--store", text(&store), "--out", text(&site)]));
    let mut python = Command::new("python3");
    python.args(["-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", text(&site)]);
    let static_files = Service::start_as(python.stderr(Stdio::null()));
    let from_files = at("from_files");
    json(&mut fetch(&static_files.url, &from_files));
    assert_eq!(ask(&from_files), ask(&served));

    // A flipped bit on the way is refused, and nothing of the scene becomes current.
    let model = files[0]["hash"].as_str().expect("a hash");
    flip(&site.join("v1/objects").join(model));
    let damaged = at("damaged");
    let refused = fetch(&static_files.url, &damaged).output().expect("starts");
    let message = String::from_utf8_lossy(&refused.stdout).into_owned();
    assert!(!refused.status.success() && message.contains(model), "{message}");
    assert!(!damaged.join("current").exists());
    // On board it is not used, and replaced.
    flip(&served.join("shards").join(model));
    let refused = edge(&QUESTION).args(["--cache", text(&served)]).output().expect("starts");
    assert!(!refused.status.success());
    assert!(String::from_utf8_lossy(&refused.stderr).contains("SHA-256"), "{refused:?}");
    let report = json(&mut fetch(&service.url, &served));
    assert_eq!(report["text_model"]["downloaded_bytes"], lens[0], "{report}");
    assert_eq!(ask(&served), ask(&from_files));
}
