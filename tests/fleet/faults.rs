//! Seeded faults: any part of a fleet is killed, stands still or comes back with nothing, and the bytes stay the same.

use std::time::Duration;

use slag_math::random::Random;

use super::nats::Fleet;
use super::support::*;

/// Seeds, unless `SLAG_FAULT_RUNS` gives another number; `SLAG_FAULT_SEED` is the first one.
const N_RUNS: u64 = 20;

#[test]
#[ignore = "half a minute a run: SLAG_FAULT_RUNS=N cargo test -p slag-tests --test fleet -- --ignored seeded"]
fn seeded_faults_do_not_show() {
    let number = |name: &str, default: u64| {
        std::env::var(name).ok().map_or(default, |text| text.parse().expect("a number"))
    };
    let (first, n_runs) = (number("SLAG_FAULT_SEED", 1), number("SLAG_FAULT_RUNS", N_RUNS));
    let mut counts = [0; 5];
    for seed in first..first + n_runs {
        let n = run_with_faults(seed);
        counts.iter_mut().zip(n).for_each(|(sum, n)| *sum += n);
        println!("seed {seed}: same bytes; {n:?}");
    }
    let [workers, pauses, servers, lost, coordinators] = counts;
    println!(
        "{n_runs} runs: {workers} workers killed, {pauses} paused, {servers} servers killed ({lost} came back empty), \
         {coordinators} coordinators killed"
    );
}

/// Returns the number of workers killed, paused, of servers killed, come back empty, of coordinators killed.
fn run_with_faults(seed: u64) -> [u64; 5] {
    let mut random = Random::new(seed);
    let (fleet, server) = Fleet::new(free_port());
    let flags = ["--ack-wait", "1", "--max-deliver", "100"];
    let mut server = Some(server);
    let mut coordinator = fleet.coordinator(&flags);
    let mut workers: Vec<Running> = (0..2).map(|_| fleet.worker(&flags)).collect();
    let mut counts = [0; 5];
    for _ in 0..1 + (random.unit() * 6.0) as usize {
        std::thread::sleep(Duration::from_secs_f64(0.2 + 2.0 * random.unit()));
        if !coordinator.is_running() {
            break;
        }
        let which = (random.unit() * workers.len() as f64) as usize;
        match (random.unit() * 10.0) as usize {
            0..4 => {
                // One that has ended by itself, as no run was open, is replaced as well.
                let new = fleet.worker(&flags);
                drop(std::mem::replace(&mut workers[which], new));
                counts[0] += 1;
            }
            4..6 if workers[which].is_running() => {
                workers[which].signal("STOP");
                std::thread::sleep(Duration::from_secs_f64(2.0 * random.unit()));
                workers[which].signal("CONT");
                counts[1] += 1;
            }
            6..8 => {
                let is_lost = random.unit() < 0.5;
                let old = server.take().expect("one runs");
                counts[2] += 1;
                counts[3] += u64::from(is_lost);
                server = Some(fleet.restart(old, is_lost));
            }
            8..10 => {
                drop(coordinator);
                coordinator = fleet.coordinator(&flags);
                counts[4] += 1;
            }
            _ => {}
        }
    }
    // Workers that ended because a run was published, or failed because the server was away, are replaced: they are a
    // scheduler's business.
    while coordinator.is_running() {
        for worker in &mut workers {
            if !worker.is_running() {
                *worker = fleet.worker(&flags);
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    let summary = coordinator.json();
    assert_eq!(summary["skipped_views"], serde_json::json!([]), "seed {seed}");
    fleet.scene.assert_same("store");
    counts
}
