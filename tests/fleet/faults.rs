//! Seeded faults: any part of a fleet is killed, paused, cut off or restarted empty, and the bytes stay the same.

use std::fmt;
use std::time::Duration;

use slag_math::random::Random;
use slag_tests::nightly;

use super::nats::Fleet;
use super::network::{Network, Weather};
use super::support::*;

/// Number of seeds, unless `SLAG_FAULT_RUNS` is set; `SLAG_FAULT_SEED` is the first.
const N_RUNS: u64 = 20;

#[nightly("half a minute a run; SLAG_FAULT_RUNS=N chooses how many")]
#[test]
fn seeded_faults_do_not_show() {
    let number = |name: &str, default: u64| {
        std::env::var(name).ok().map_or(default, |text| text.parse().expect("a number"))
    };
    let (first, n_runs) = (number("SLAG_FAULT_SEED", 1), number("SLAG_FAULT_RUNS", N_RUNS));
    let mut all = Faults::default();
    for seed in first..first + n_runs {
        let faults = run_with_faults(seed);
        println!("seed {seed}: same bytes; {faults}");
        all.add(faults);
    }
    println!("{n_runs} runs: {all}");
}

/// Faults of a fleet.
#[derive(Clone, Copy, Default)]
struct Faults {
    n_workers_killed: u64,
    n_workers_paused: u64,
    n_partitions: u64,
    n_slow_networks: u64,
    n_servers_killed: u64,
    n_servers_emptied: u64,
    n_coordinators_killed: u64,
}

impl Faults {
    fn add(&mut self, other: Self) {
        self.n_workers_killed += other.n_workers_killed;
        self.n_workers_paused += other.n_workers_paused;
        self.n_partitions += other.n_partitions;
        self.n_slow_networks += other.n_slow_networks;
        self.n_servers_killed += other.n_servers_killed;
        self.n_servers_emptied += other.n_servers_emptied;
        self.n_coordinators_killed += other.n_coordinators_killed;
    }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} workers killed, {} paused, {} cut off, {} on a slow network, {} servers killed ({} came back empty), \
             {} coordinators killed",
            self.n_workers_killed,
            self.n_workers_paused,
            self.n_partitions,
            self.n_slow_networks,
            self.n_servers_killed,
            self.n_servers_emptied,
            self.n_coordinators_killed
        )
    }
}

fn run_with_faults(seed: u64) -> Faults {
    let mut random = Random::new(seed);
    let (fleet, server) = Fleet::new(free_port());
    let flags = ["--ack-wait", "1", "--max-deliver", "100"];
    let networks = [0, 1].map(|_| Network::to(server.port, random.bits()));
    let start = |which: usize| fleet.worker_over(&networks[which], &flags);
    let mut server = Some(server);
    let mut coordinator = fleet.coordinator(&flags);
    let mut workers = [start(0), start(1)];
    let mut faults = Faults::default();
    for _ in 0..1 + random.below(7usize) {
        std::thread::sleep(Duration::from_secs_f64(0.1 + 1.5 * random.unit()));
        if !coordinator.is_running() {
            break;
        }
        let which = random.below(workers.len());
        match random.below(12u32) {
            0..3 => {
                // One that ended because no run was open is also replaced.
                drop(std::mem::replace(&mut workers[which], start(which)));
                faults.n_workers_killed += 1;
            }
            3..5 if workers[which].is_running() => {
                workers[which].signal("STOP");
                std::thread::sleep(Duration::from_secs_f64(2.0 * random.unit()));
                workers[which].signal("CONT");
                faults.n_workers_paused += 1;
            }
            5..7 => {
                networks[which].set(Weather { is_cut: true, ..Weather::default() });
                std::thread::sleep(Duration::from_secs_f64(3.0 * random.unit()));
                networks[which].set(Weather::default());
                faults.n_partitions += 1;
            }
            7..9 => {
                let delay = Duration::from_secs_f64(0.05 * random.unit());
                networks[which].set(Weather { delay, loss: 0.1 * random.unit(), is_cut: false });
                faults.n_slow_networks += 1;
            }
            9..11 => {
                let is_lost = random.unit() < 0.5;
                let old = server.take().expect("one runs");
                faults.n_servers_killed += 1;
                faults.n_servers_emptied += u64::from(is_lost);
                server = Some(fleet.restart(old, is_lost));
            }
            11 => {
                drop(coordinator);
                coordinator = fleet.coordinator(&flags);
                faults.n_coordinators_killed += 1;
            }
            _ => {}
        }
    }
    // A scheduler would replace workers that ended after a publication or because the server was away.
    while coordinator.is_running() {
        for (which, worker) in workers.iter_mut().enumerate() {
            if !worker.is_running() {
                *worker = start(which);
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    let summary = coordinator.json();
    assert_eq!(summary["skipped_views"], serde_json::json!([]), "seed {seed}");
    fleet.scene.assert_same("store");
    faults
}
