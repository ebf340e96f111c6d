//! The real program over a real socket: fetch, status, query, serve, and exit codes.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use glam::DVec3;
use serde_json::Value;
use slag_common::Hash32;
use slag_common::frames::Aabb;
use slag_common::manifest::{self, Manifest};
use slag_common::shard::sample::{self, SampleShard};
use slag_common::shard::{Profile, ShardHeader, quantise};
use slag_common::tuf::{generate_key, one_key_repository};
use slag_edge::text::TextService;
use slag_models::{ModelDir, SessionOptions};

use crate::fetch::scene::Published;
use crate::fetch::server::Server;

/// A scene's manifest and single shard: 40 red Gaussians around x = 2, 60 blue ones around x = 8, built-in colours.
fn red_and_blue() -> (Vec<u8>, Vec<u8>) {
    let mut positions: Vec<[u16; 3]> = (0..40).map(|i| [2000 + i, 0, 0]).collect();
    positions.extend((0..60).map(|i| [8000 + i, 0, 0]));
    painted(&positions, 40)
}

/// Returns manifest and single shard of a scene of `n_red` red, then blue Gaussians; positions in millimetres.
fn painted(positions: &[[u16; 3]], n_red: u32) -> (Vec<u8>, Vec<u8>) {
    let text = TextService::open(&ModelDir::colours(), &SessionOptions::new("not-needed".into())).unwrap();
    let vector = |word: &str| text.encode(word).expect("known").to_vec();
    let (centroids, centroid_step) = quantise(&[vector("red"), vector("blue")].concat());
    let bounds = Aabb { min: DVec3::ZERO, max: DVec3::splat(10.0) };
    let n = positions.len();
    let header = sample::header(0, n, 2, text.info().dim as usize, bounds);
    let shard = SampleShard {
        header: ShardHeader {
            centroid_step,
            position_step: [1e-3; 3],
            encoder_id: text.info().id.0,
            ..header
        },
        positions: positions.to_vec(),
        centroid_starts: vec![0, n_red, n as u32],
        centroids,
        radii: vec![0.05; 2],
        embeddings: None,
    };
    let shard = shard.to_bytes();
    let mut manifest = Manifest { generation: 3, ..sample::manifest("paint", &[(Profile::Compact, &shard)]) };
    (manifest.encoder.name, manifest.encoder.default_threshold) = (text.info().name.clone(), 0.8);
    (manifest.to_bytes(), shard)
}

/// Serves a scene of one shard for as long as the tests run; returns the store's address.
fn store((listed, shard): (Vec<u8>, Vec<u8>)) -> String {
    let manifest = Manifest::parse(&listed).expect("valid");
    let metadata = one_key_repository(&generate_key(), 3, manifest::TARGET, &listed);
    let objects = BTreeMap::from([(Hash32::of(&shard), shard)]);
    let server = Server::start(Published { manifest, listed, metadata, objects });
    Box::leak(Box::new(server)).url()
}

/// Returns a cache with a one-shard scene.
fn fetched(scene: (Vec<u8>, Vec<u8>)) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a folder");
    let from = store(scene);
    assert_eq!(run(dir.path(), &["fetch", "--trust-first", "--from", &from, "--at", "0,0,0"]).0, Some(0));
    dir
}

fn serve(cache: &Path, args: &[&str]) -> (Child, String) {
    let mut serving = slag_edge(cache, &[&["serve", "--listen", "127.0.0.1:0"], args].concat());
    let mut serving = serving.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("runs");
    let mut line = String::new();
    BufReader::new(serving.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
    let url = line.trim().strip_prefix("listening on ").expect("an address").to_owned();
    (serving, url)
}

fn signal(program: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &program.id().to_string()]).status().expect("runs").success());
}

fn stop(mut serving: Child) -> String {
    signal(&serving, "-TERM");
    assert_eq!(serving.wait().expect("ends").code(), Some(0));
    let mut log = String::new();
    serving.stderr.take().expect("a pipe").read_to_string(&mut log).expect("text");
    log
}

fn slag_edge(cache: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_slag-edge"));
    command.args(args).arg("--cache").arg(cache).env_remove("RUST_LOG");
    if ["query", "serve"].contains(&args[0]) {
        command.args(["--models", "colours"]);
    }
    command
}

fn run(cache: &Path, args: &[&str]) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = slag_edge(cache, args).output().expect("runs");
    (
        status.code(),
        String::from_utf8_lossy(&stdout).into_owned(),
        String::from_utf8_lossy(&stderr).into_owned(),
    )
}

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"))
}

/// Runs a line with `--json`; returns its exit code, and a member of what it prints.
fn told(cache: &Path, line: &str, member: &str) -> (Option<i32>, Value) {
    let (code, out, _) = run(cache, &[&line.split(' ').collect::<Vec<_>>()[..], &["--json"]].concat());
    (code, json(&out).pointer(member).cloned().unwrap_or_default())
}

fn get(url: &str) -> (u16, Value) {
    let agent: ureq::Agent = ureq::Agent::config_builder().http_status_as_error(false).build().into();
    let mut response = agent.get(url).call().expect("an answer");
    (response.status().as_u16(), json(&response.body_mut().read_to_string().expect("a body")))
}

#[test]
fn a_robot_fetches_asks_and_serves() {
    let from = store(red_and_blue());
    let dir = tempfile::tempdir().expect("a folder");
    let cache = dir.path().join("cache");

    let failed = |kind: &str| (Some(1), Value::from(kind));
    assert_eq!(told(&cache, "query red", "/error/kind"), failed("no-scene"));
    let (code, out, err) = run(
        &cache,
        &["fetch", "--trust-first", "--from", &from, "--at", "0,0,0", "--radius", "20", "--json"],
    );
    assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
    assert_eq!(json(&out)["downloaded"]["n_shards"], 1);
    assert_eq!(told(&cache, "status", "/n_gaussians"), (Some(0), 100.into()));
    assert_eq!(told(&cache, "status", "/generation").1, 3);

    let (code, out, _) = run(&cache, &["query", "a red thing", "--near", "-1,0,0", "--json"]);
    let answer = &json(&out)["answers"][0];
    assert_eq!((code, &answer["n_gaussians"]), (Some(0), &40.into()));
    assert!((answer["distance"].as_f64().expect("a number") - 3.0195).abs() < 1e-9);
    for (colour, at, note) in [
        ("blue", "8.03, 0.00, 0.00", "60 Gaussians of 100"),
        ("yellow", "", "no Gaussian of the 100 searched"),
    ] {
        let (code, out, err) = run(&cache, &["query", colour]);
        assert!(code == Some(0) && out.contains(at) && err.contains(note), "{out}{err}");
        assert_eq!(out.is_empty(), at.is_empty(), "{out}");
    }
    assert_eq!(told(&cache, "query sofa", "/error/kind"), failed("unknown-words"));
    assert_eq!(run(&cache, &["query", " "]).0, Some(2));
    assert_eq!(run(&cache, &["query", "red", "--limit", "0"]).0, Some(2));
    assert_eq!(run(&cache, &["list", "--limit", "0"]).0, Some(2));
    let centre = run(&cache, &["locate", "absent.jpg", "--focal-px", "500", "--centre-px", "320,240"]);
    assert!(centre.0 == Some(1) && centre.2.contains("absent.jpg"), "{}", centre.2);

    let (serving, url) = serve(&cache, &[]);
    let (code, answers) = get(&format!("{url}/query?text=blue"));
    assert_eq!((code, &answers["answers"][0]["n_gaussians"]), (200, &60.into()));
    assert_eq!(get(&format!("{url}/query?text=blue&radius=1")).0, 400);
    assert_eq!(get(&format!("{url}/status")).1["is_ready"], true);
    let log = stop(serving);
    assert!(log.contains("stopping"), "{log}");
}

/// systemd is told that the service is ready, alive, and stopping.
#[test]
#[cfg(target_os = "linux")]
fn a_supervisor_hears_of_start_life_and_stop() {
    let dir = tempfile::tempdir().expect("a folder");
    let socket = std::os::unix::net::UnixDatagram::bind(dir.path().join("notify")).expect("binds");
    let heard = || {
        let mut bytes = [0; 64];
        let n = socket.recv(&mut bytes).expect("a word");
        String::from_utf8_lossy(&bytes[..n]).trim().to_owned()
    };
    let mut serving = slag_edge(dir.path(), &["serve", "--listen", "127.0.0.1:0"]);
    serving.env("NOTIFY_SOCKET", dir.path().join("notify")).env("WATCHDOG_USEC", "30000");
    let mut serving = serving.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("runs");
    assert_eq!([heard(), heard()], ["READY=1", "WATCHDOG=1"]);
    signal(&serving, "-TERM");
    assert_eq!(std::iter::repeat_with(heard).find(|word| word != "WATCHDOG=1").unwrap(), "STOPPING=1");
    assert_eq!(serving.wait().expect("ends").code(), Some(0));
}

/// The store never answers: ctrl-c ends the fetch with exit code 130.
#[test]
fn an_interrupted_fetch_says_so() {
    let silent = TcpListener::bind("127.0.0.1:0").expect("a port");
    let from = format!("http://{}", silent.local_addr().expect("an address"));
    let dir = tempfile::tempdir().expect("a folder");
    let mut fetching = slag_edge(dir.path(), &["fetch", "--trust-first", "--from", &from, "--at", "0,0,0"]);
    let fetching = fetching.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("runs");
    // The signal handler is installed before it connects. Closing the connection makes it retry and check the flag.
    let (connection, _) = silent.accept().expect("a connection");
    signal(&fetching, "-INT");
    drop(connection);
    let output = fetching.wait_with_output().expect("ends");
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn nobody_reads_and_nobody_complains() {
    let dir = fetched(red_and_blue());
    let mut child = slag_edge(dir.path(), &["query", "red", "--kind", "gaussians", "--json"]);
    let mut child = child.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("runs");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("ends");
    assert_eq!((output.status.code(), output.stderr.len()), (Some(0), 0));
}

/// Positions on stdin: the first is fetched, nearby ones are not, and invalid lines are reported and skipped.
#[test]
fn a_robot_is_followed_along_stdin() {
    let dir = tempfile::tempdir().expect("a folder");
    let from = store(red_and_blue());
    let watch = |text: &str| {
        let args = format!(
            "fetch --trust-first --watch --from {from} --radius 20 --margin 4 --min-interval-secs 0 --json"
        );
        let mut child = slag_edge(dir.path(), &args.split(' ').collect::<Vec<_>>());
        child.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = child.spawn().expect("runs");
        child.stdin.take().expect("a pipe").write_all(text.as_bytes()).expect("written");
        let Output { status, stdout, stderr } = child.wait_with_output().expect("ends");
        let reports: Vec<Value> = String::from_utf8_lossy(&stdout).lines().map(json).collect();
        (status.code(), reports, String::from_utf8_lossy(&stderr).into_owned())
    };
    // Timing decides which positions are seen, except the last.
    let (code, reports, log) = watch("1 2 3\nnonsense\n\n1 2 4\n{\"x\":1,\"y\":2,\"z\":3}\n");
    assert_eq!((code, reports.len()), (Some(0), 1), "{log}");
    assert_eq!((&reports[0]["n_cells"], &reports[0]["radius"]), (&1.into(), &24.0.into()));
    assert!(log.contains("line 2: \"nonsense\" is not a position"), "{log}");
    // A geographic position is meaningless in this scene: the last fetch fails, and the generation on board stays.
    let (code, reports, log) = watch("46.8,-92\n");
    assert_eq!((code, &reports[0]["error"]["kind"]), (Some(1), &"fetch".into()), "{log}");
    assert!(reports[0]["error"]["detail"].as_str().is_some_and(|text| text.contains("geo-reference")));
    assert_eq!(run(dir.path(), &["query", "red", "--json"]).0, Some(0));
    for nothing in ["", "nonsense\n"] {
        let (code, reports, log) = watch(nothing);
        assert_eq!((code, &reports[0]["error"]["kind"]), (Some(1), &"positions".into()), "{log}");
    }
    let (code, out, _) = run(dir.path(), &["fetch", "--scene", "other", "--json"]);
    assert!(code == Some(1) && out.contains(r#"fetch --scene \"paint\""#), "{out}");
    let root = dir.path().join("a.root.json");
    fs_err::write(&root, "{}").expect("written");
    let root = root.to_str().expect("UTF-8");
    let (code, out, _) = run(dir.path(), &["trust", "add", "--root", root, "--json"]);
    assert!(code == Some(1) && out.contains(root), "{out}");
}

#[test]
fn a_robot_is_followed_by_its_service() {
    let dir = tempfile::tempdir().expect("a folder");
    let from = store(red_and_blue());
    let (serving, url) = serve(dir.path(), &["--trust-first", "--follow", &from, "--radius", "20"]);
    assert_eq!(get(&format!("{url}/query?text=blue")).0, 503);
    let posted = ureq::post(format!("{url}/position")).content_type("application/json");
    assert_eq!(posted.send(r#"{"x":1,"y":2,"z":3}"#).expect("an answer").status().as_u16(), 202);
    let give_up = Instant::now() + Duration::from_secs(60);
    loop {
        let ((code, answers), (_, status)) =
            (get(&format!("{url}/query?text=blue")), get(&format!("{url}/status")));
        if code == 200 && status["following"]["n_fetches"] == 1 {
            assert_eq!(answers["answers"][0]["n_gaussians"], 60);
            assert_eq!(status["is_expired"], false);
            break;
        }
        assert!(Instant::now() < give_up, "the scene does not come in: {status}");
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(stop(serving).contains("fetched 1 shards of generation 3"));
}

/// As after a fetch whose cells were all taken from the scene.
#[test]
fn a_robot_without_cells_is_told_to_fetch() {
    let dir = fetched(red_and_blue());
    let path = dir.path().join("current");
    let mut current = json(&fs_err::read_to_string(&path).expect("text"));
    current["cells"] = serde_json::json!([]);
    fs_err::write(&path, current.to_string()).expect("written");
    let (code, out, _) = run(dir.path(), &["doctor", "--models", "colours"]);
    let scene = out.lines().find(|line| line.contains("0 of 1 cells")).unwrap_or_default();
    assert!(scene.starts_with("MISSING") && scene.contains("slag-edge fetch --at"), "{out}");
    assert!(code == Some(1) && !out.contains("--occupancy"), "{out}");
    fs_err::write(&path, "").expect("written");
    let (_, out, _) = run(dir.path(), &["doctor"]);
    assert!(out.lines().all(|line| line.matches("fetch again").count() < 2), "{out}");
}

/// A page is lost after the shard was checked and mapped: the program ends once, its next start does not answer from
/// that shard, and the next fetch replaces it.
#[test]
#[cfg(target_os = "linux")]
fn a_page_that_cannot_be_read_ends_the_program_and_is_fetched_again() {
    use std::os::unix::process::ExitStatusExt;
    const SIGBUS: i32 = 7;
    let (listed, shard) = red_and_blue();
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("shards").join(Hash32::of(&shard).to_string());
    let from = store((listed, shard));
    let fetch = format!("fetch --trust-first --from {from} --at 0,0,0");
    assert_eq!(told(dir.path(), &fetch, "").0, Some(0));
    let (mut serving, url) = serve(dir.path(), &[]);
    assert_eq!(get(&format!("{url}/query?text=blue")).0, 200);
    fs_err::OpenOptions::new().write(true).open(&path).expect("on board").set_len(0).expect("cut");
    assert!(ureq::get(format!("{url}/query?text=blue")).call().is_err());
    assert_eq!(serving.wait().expect("ends").signal(), Some(SIGBUS));
    let (code, out, err) = run(dir.path(), &["query", "blue", "--json"]);
    assert_eq!(code, Some(1), "{out}{err}");
    assert_eq!(told(dir.path(), &fetch, "/downloaded/n_shards"), (Some(0), 1.into()));
    assert_eq!(run(dir.path(), &["query", "blue"]).0, Some(0));
}

/// A sector that gives EIO when the service starts: it listens, names the cell, and answers after the next fetch.
#[slag_test_support::needs_loop_disk]
fn a_service_starts_with_a_sector_that_cannot_be_read() {
    let dir = tempfile::tempdir().expect("a folder");
    let disk = slag_test_support::LoopDisk::new(dir.path());
    let (listed, shard) = painted(&[[5000; 3]; 4000], 2000);
    let path = disk.path().join("shards").join(Hash32::of(&shard).to_string());
    let from = store((listed, shard));
    let fetch = format!("fetch --trust-first --from {from} --at 0,0,0");
    assert_eq!(told(disk.path(), &fetch, "").0, Some(0));
    disk.break_block(&path, 15);
    let (serving, url) = serve(disk.path(), &[]);
    assert_eq!(get(&format!("{url}/query?text=blue")).0, 503);
    assert!(stop(serving).contains("cannot be read"));
    assert_eq!(told(disk.path(), &fetch, "/downloaded/n_shards"), (Some(0), 1.into()));
    assert_eq!(run(disk.path(), &["query", "blue"]).0, Some(0));
}

/// Returns a memory figure of a program; 0 where Linux has none.
fn bytes_of(program: &Child, figure: &str) -> u64 {
    let status = fs_err::read_to_string(format!("/proc/{}/status", program.id())).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(figure)).unwrap_or("0 kB");
    line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") << 10
}

/// The robot's program includes the embedded text model, but not the image model, larger than all others together.
#[test]
fn the_image_model_stays_with_the_encoder() {
    let program = std::fs::read(env!("CARGO_BIN_EXE_slag-edge")).expect("the program");
    let carries = |model: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../common/models/embedded").join(model);
        let model = std::fs::read(path).expect("embedded");
        let middle = &model[model.len() / 2..][..256];
        program.windows(middle.len()).any(|bytes| bytes == middle)
    };
    assert_eq!((carries("text.onnx"), carries("image.onnx")), (true, false));
}

/// 32 at once, three times: their total memory is bounded, and refusals name the budget.
#[test]
#[cfg(target_os = "linux")]
fn the_memory_attack_stays_within_the_budget() {
    const QUERY_BYTES: u64 = 64 << 20;
    // Every Gaussian matches and is its own cluster, whatever the limit.
    const ATTACK: &str = "kind=clusters&threshold=-1&min_count=1&voxel=1e-9&limit=1";
    // 120,000 of them, 0.1 m apart.
    let grid = |i: u32| [i % 100, i / 100 % 100, i / 10_000].map(|at| at as u16 * 100);
    let dir = fetched(painted(&(0..120_000).map(grid).collect::<Vec<_>>(), 60_000));
    let (serving, url) =
        serve(dir.path(), &["--max-query-secs", "600", "--max-query-bytes", &QUERY_BYTES.to_string()]);
    let peak_bytes = || bytes_of(&serving, "VmHWM:");
    let before = peak_bytes();
    let ask = || (0..3).map(|_| get(&format!("{url}/query?text=red&{ATTACK}"))).collect::<Vec<_>>();
    let answers: Vec<(u16, Value)> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..32).map(|_| scope.spawn(ask)).collect();
        clients.into_iter().flat_map(|client| client.join().expect("asks")).collect()
    });
    let grown = peak_bytes() - before;
    stop(serving);
    let n_answered = answers.iter().filter(|(status, _)| *status == 200).count();
    println!("{n_answered} of 96 answered; memory grew from {before} by {grown} bytes");
    for (status, answer) in &answers {
        let refusal = answer["detail"].as_str().unwrap_or_default();
        let holds = *status == 200 || *status == 503 && refusal.contains(&(4 * QUERY_BYTES).to_string());
        assert!(holds, "{answer}");
    }
    assert!(n_answered > 0);
    // Four queries' worth, and twice as much again for uncounted memory: text models, stacks, the allocator's.
    assert!(grown < 12 * QUERY_BYTES, "{grown}");
}
