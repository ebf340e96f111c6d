//! A store with the text side of its encoder: robots fetch it with the scene and need no models of their own.

use super::*;

use slag_tests::*;

/// The nearest Gaussians whatever their scores, so that equal vectors give equal answers.
const QUESTION: [&str; 5] = ["query", "chair", "--kind", "gaussians", "--threshold=-1"];

/// Models that no program has built in: the embedded ones with another prompt.
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

/// Asks a robot without `--models`.
fn ask(cache: &Path) -> Value {
    let home = tempfile::tempdir().expect("a temporary folder");
    let mut question = edge(&QUESTION);
    question.args(["--cache", text(cache)]).env("HOME", home.path()).env_remove("XDG_CACHE_HOME");
    let answers = run_json(&mut question)["answers"].clone();
    let left = std::fs::read_dir(home.path()).expect("listed").count();
    assert_eq!(left, 0, "ONNX Runtime leaves no identity and no log of its use");
    answers
}

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
    let (store, site) = (at("store"), at("site"));
    let encode = |models: &Path, store: &Path, flags: &[&str]| {
        let mut command = encode_quickly(&generated(&ROOM), store);
        command.args("--views-limit 2 --view-order nth --device cpu --keep-views".split(' '));
        command.args(["--models", text(models)]).args(flags);
        command
    };
    // A licence that forbids it is reported before the work.
    let restricted = models(&at("restricted"), "apple-amlr");
    refused(&mut encode(&restricted, &at("refused"), &["--text-model"]), "apple-amlr");
    assert!(!at("refused").exists(), "no empty store is left behind");
    assert!(!at("refused").join("manifest").exists());

    let models = models(&at("models"), "Apache-2.0 OR MIT");
    run(&mut encode(&models, &store, &[]));
    let plain = content(&store);
    assert!(!fs_err::read_to_string(store.join("manifest")).expect("there").contains("text_model"));
    run(&mut encode(&models, &store, &["--text-model"]));
    assert_eq!(content(&store), plain, "the shards do not depend on it");
    let manifest = read_json(&store.join("manifest"));
    let carried = &manifest["encoder"]["text_model"];
    let files = carried["files"].as_array().expect("files");
    let len = |name: &str| fs_err::metadata(models.join(name)).expect("there").len();
    let lens: Vec<u64> = files.iter().filter_map(|file| file["len_bytes"].as_u64()).collect();
    assert_eq!(lens, [len("text.onnx"), len("tokenizer.json")]);
    let total = lens.iter().sum::<u64>() + carried["description"]["len_bytes"].as_u64().expect("a length");

    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    let with_models = at("with_models");
    run_json(&mut fetch(&service.url, &with_models));
    let expected = run_json(edge(&QUESTION).args(["--cache", text(&with_models), "--models", text(&models)]))
        ["answers"]
        .clone();
    assert!(expected.as_array().is_some_and(|answers| !answers.is_empty()), "{expected}");
    // The next generation has the same text model.
    run(&mut encode(&models, &store, &["--text-model", "--compact-error", "0.4"]));
    fs_err::remove_dir_all(&models).expect("removed");
    assert_eq!(ask(&with_models), expected);

    // Over the service. The robot was started with nothing on board.
    let served = at("served");
    let robot = Service::start(&mut edge(&["serve", "--cache", text(&served)]));
    let report = run_json(&mut fetch(&service.url, &served));
    let found = (&report["text_model"]["bytes"], &report["text_model"]["downloaded_bytes"]);
    assert_eq!(found, (&total.into(), &total.into()));
    // It loads in the background.
    let is_ready = |_| {
        std::thread::sleep(Duration::from_millis(100));
        ureq::get(format!("{}/readyz", robot.url)).call().is_ok()
    };
    assert!((0..300).any(is_ready), "the robot does not take the scene with its text model");
    let answers = robot.get("/query?text=chair&kind=gaussians&threshold=-1");
    assert_eq!(answers["answers"], ask(&served), "{answers}");
    // A robot with the previous generation fetches shards only.
    let report = run_json(&mut fetch(&service.url, &with_models));
    let found = (&report["generation"], &report["text_model"]["downloaded_bytes"]);
    assert_eq!(found, (&3.into(), &0.into()), "{report}");
    assert_eq!(ask(&with_models), ask(&served));

    // Unneeded objects are removed; the text model stays.
    run_json(&mut encoder(&["store", "gc", "--store", text(&store)]));
    let found = run_json(&mut encoder(&["store", "verify", "--store", text(&store)]));
    assert_eq!(found["bad"], serde_json::json!([]));

    // Over static files.
    run_json(&mut encoder(&["store", "export", "--store", text(&store), "--out", text(&site)]));
    let static_files = Service::of_files(&site);
    let from_files = at("from_files");
    run_json(&mut fetch(&static_files.url, &from_files));
    assert_eq!(ask(&from_files), ask(&served));

    // A flipped bit on the way is refused, and the scene does not become current.
    let model = files[0]["hash"].as_str().expect("a hash");
    flip(&site.join("v1/objects").join(model));
    let damaged = at("damaged");
    refused(&mut fetch(&static_files.url, &damaged), model);
    assert!(!damaged.join("current").exists());
    // A damaged file on board is not used, and replaced.
    flip(&served.join("shards").join(model));
    refused(edge(&QUESTION).args(["--cache", text(&served)]), "SHA-256");
    let report = run_json(&mut fetch(&service.url, &served));
    assert_eq!(report["text_model"]["downloaded_bytes"], lens[0], "{report}");
    assert_eq!(ask(&served), ask(&from_files));
}
