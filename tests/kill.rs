//! Power cuts: encode and fetch are killed at random moments and started again.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
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

/// Runs a command to its end and returns what it printed, or kills it after a while.
fn run_or_kill(command: &mut Command, after: Duration) -> Option<Vec<u8>> {
    // What is printed is less than a pipe holds, so nobody has to read meanwhile.
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("starts");
    let start = Instant::now();
    while start.elapsed() < after {
        if let Some(status) = child.try_wait().expect("waits") {
            assert!(status.success(), "{command:?}: {status}");
            return Some(child.wait_with_output().expect("waits").stdout);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("kill -9");
    child.wait().expect("waits");
    None
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
    while n_kills < N_KILLS {
        let store = dir.path().join(format!("store{n_stores}"));
        let printed = loop {
            let enough = n_kills == N_KILLS;
            let after = if enough { Duration::MAX } else { encode_time.mul_f64(0.5 * random(&mut state)) };
            match run_or_kill(&mut encode(&room, &store), after) {
                Some(printed) => break printed,
                None => n_kills += 1,
            }
            if store.join("manifest").exists() {
                assert_eq!(content(&store), expected, "a visible manifest is a whole one");
            }
        };
        let summary: Value = serde_json::from_slice(&printed).expect("a summary");
        n_resumed += summary["n_views_resumed"].as_u64().expect("a count");
        assert_eq!(content(&store), expected);
        n_stores += 1;
    }
    assert!(n_resumed > 0, "no killed encode was resumed");
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
        |cache: &Path| run_json(&mut edge(&["query", "blue", "--cache", text(cache)]))["answers"].clone();
    let expected = answer(&reference);
    assert!(!expected.as_array().expect("answers").is_empty());
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
