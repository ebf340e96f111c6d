//! Power cuts: encode and fetch are killed at random moments and started again.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use slag_tests::*;

const N_KILLS: usize = 20;

/// A pseudo-random sequence in 0..1 (SplitMix64).
fn random(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (z ^ (z >> 31)) as f64 / u64::MAX as f64
}

/// Runs a command to its end or kills it after a while; returns whether it was killed.
fn run_or_kill(command: &mut Command, after: Duration) -> bool {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
    let start = Instant::now();
    loop {
        if let Some(status) = child.try_wait().expect("waits") {
            assert!(status.success(), "{command:?}: {status}");
            return false;
        }
        if start.elapsed() >= after {
            child.kill().expect("kill -9");
            child.wait().expect("waits");
            return true;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn encode(room: &Path, store: &Path) -> Command {
    let (scene, views) = (room.join("scene.ply"), room.join("transforms.json"));
    let mut command = encoder(&[
        "encode",
        "--scene",
        text(&scene),
        "--views",
        text(&views),
        "--metric",
        "--cell-gaussians",
        "4096",
        "--store",
        text(store),
        "--json",
    ]);
    command.env("SOURCE_DATE_EPOCH", "1700000000");
    command
}

#[test]
fn killed_encodes_and_fetches_resume_and_show_nothing_half() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = dir.path().join("room");
    run(&mut encoder(&["generate", "--out", text(&room), "--n-views", "10"]));
    let whole = dir.path().join("whole");
    let start = Instant::now();
    run(&mut encode(&room, &whole));
    let encode_time = start.elapsed();
    let expected = content(&whole);

    // Killed again and again, within the first half so that several kills hit each store; a store that got
    // finished in between makes room for the next.
    let mut state = 7;
    let (mut n_kills, mut n_stores, mut n_resumed) = (0, 0, 0);
    while n_kills < N_KILLS || n_stores == 0 {
        let store = dir.path().join(format!("store{n_stores}"));
        while n_kills < N_KILLS
            && run_or_kill(&mut encode(&room, &store), encode_time.mul_f64(0.5 * random(&mut state)))
        {
            n_kills += 1;
            if store.join("manifest").exists() {
                assert_eq!(content(&store), expected, "a visible manifest is a whole one");
            }
        }
        let summary = run_json(&mut encode_without_json(&room, &store));
        n_resumed += summary["n_views_resumed"].as_u64().expect("a count");
        assert_eq!(content(&store), expected);
        n_stores += 1;
    }
    println!("encode: {n_kills} kills, {n_stores} stores, {n_resumed} views not done twice");

    let server = Service::start(&mut encoder(&["serve", "--store", text(&whole)]));
    let fetch = |cache: &Path| {
        edge(&[
            "fetch",
            "--from",
            &server.url,
            "--at",
            "3.5,2.7,0",
            "--radius",
            "50",
            "--cache",
            text(cache),
            "--json",
        ])
    };
    let reference = dir.path().join("cache");
    let start = Instant::now();
    run(&mut fetch(&reference));
    let fetch_time = start.elapsed();
    let answer =
        |cache: &Path| run_json(&mut edge(&["query", "red", "--cache", text(cache)]))["answers"].clone();
    let expected = answer(&reference);
    for kill in 0..N_KILLS {
        let cache = dir.path().join(format!("cache{kill}"));
        run_or_kill(&mut fetch(&cache), fetch_time.mul_f64(random(&mut state)));
        if cache.join("current").exists() {
            assert_eq!(answer(&cache), expected, "what is visible is whole");
        }
        run(&mut fetch(&cache));
        assert_eq!(answer(&cache), expected);
    }
}

/// `run_json` adds the flag itself.
fn encode_without_json(room: &Path, store: &Path) -> Command {
    let with = encode(room, store);
    let mut command = Command::new(with.get_program());
    command.args(with.get_args().filter(|arg| *arg != "--json")).env("SOURCE_DATE_EPOCH", "1700000000");
    command
}
