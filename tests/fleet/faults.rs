//! Seeded faults: any part of a fleet is killed, paused, cut off or restarted empty, and the bytes stay the same.

use super::*;
use std::collections::BTreeMap;
use std::fmt;

use slag_tests::nightly;

use super::nats::Fleet;
use super::network::Weather;
use super::support::*;

/// Number of seeds, unless `SLAG_FAULT_RUNS` is set; `SLAG_FAULT_SEED` is the first.
const N_RUNS: u64 = 20;

#[nightly("half a minute a run; SLAG_FAULT_RUNS=N chooses how many")]
fn seeded_faults_do_not_show() {
    let number = |name: &str, default: u64| {
        std::env::var(name).ok().map_or(default, |text| text.parse().expect("a number"))
    };
    let (first, n_runs) = (number("SLAG_FAULT_SEED", 1), number("SLAG_FAULT_RUNS", N_RUNS));
    let mut all = Faults::default();
    for seed in first..first + n_runs {
        let faults = run_with_faults(seed);
        println!("seed {seed}: same bytes; {faults}");
        faults.0.into_iter().for_each(|(fault, n)| *all.0.entry(fault).or_default() += n);
    }
    println!("{n_runs} runs: {all}");
}

/// Faults of a fleet, and how often each was made.
#[derive(Default)]
struct Faults(BTreeMap<&'static str, u64>);

impl Faults {
    fn count(&mut self, fault: &'static str) {
        *self.0.entry(fault).or_default() += 1;
    }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let told: Vec<String> = self.0.iter().map(|(fault, n)| format!("{n} {fault}")).collect();
        f.write_str(&told.join(", "))
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
                faults.count("workers killed");
            }
            3..5 if workers[which].is_running() => {
                workers[which].signal("STOP");
                std::thread::sleep(Duration::from_secs_f64(2.0 * random.unit()));
                workers[which].signal("CONT");
                faults.count("workers paused");
            }
            5..7 => {
                networks[which].set(Weather { is_cut: true, ..Weather::default() });
                std::thread::sleep(Duration::from_secs_f64(3.0 * random.unit()));
                networks[which].set(Weather::default());
                faults.count("workers cut off");
            }
            7..9 => {
                let delay = Duration::from_secs_f64(0.05 * random.unit());
                networks[which].set(Weather { delay, loss: 0.1 * random.unit(), is_cut: false });
                faults.count("workers on a slow network");
            }
            9..11 => {
                let is_lost = random.unit() < 0.5;
                let old = server.take().expect("one runs");
                faults.count(if is_lost { "servers replaced by empty ones" } else { "servers killed" });
                server = Some(fleet.restart(old, is_lost));
            }
            11 => {
                drop(coordinator);
                coordinator = fleet.coordinator(&flags);
                faults.count("coordinators killed");
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
    assert_eq!(coordinator.json()["skipped_views"], serde_json::json!([]), "seed {seed}");
    fleet.scene.assert_same("store");
    faults
}
