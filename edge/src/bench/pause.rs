//! Measures how long a query waits while fetches replace the generation, through the real service and
//! sockets.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;
use slag_common::tuf::generate_key;

use super::machine::Machine;
use super::robot::{Robot, RobotError};
use super::scene::{Generator, Shelf};
use super::times::{Percentiles, Times};
use super::timing::quantile;

/// Parameters of the measurement.
#[derive(Clone, Debug)]
pub struct PauseOptions {
    /// Gaussians of the generated scene.
    pub n_gaussians: u32,
    /// Components of an embedding.
    pub dim: u32,
    /// Number of fetches, each of a generation in which half the cells are new.
    pub n_fetches: u32,
    /// Duration of the queries without fetches, as a baseline.
    pub idle: Duration,
    /// Work folder; created, and cleared of the cache at the end.
    pub work_dir: PathBuf,
}

/// Report of the measurement.
#[derive(Clone, Debug, Serialize)]
pub struct PauseReport {
    /// The machine.
    pub machine: Machine,
    /// Gaussians on board.
    pub n_gaussians: u32,
    /// Components of an embedding.
    pub dim: u32,
    /// Fetches.
    pub n_fetches: u32,
    /// Bytes downloaded per fetch.
    pub bytes_per_fetch: u64,
    /// Median time of a fetch and of loading its generation.
    pub fetch_median_ms: f64,
    /// Response times while nothing is fetched.
    pub idle: Percentiles,
    /// Response times during a fetch or the loading of a generation.
    pub fetching: Percentiles,
    /// Longest response time while fetching: no pause is longer.
    pub longest_pause_ms: f64,
    /// Generations that answered.
    pub n_generations_seen: usize,
}

/// One answered query.
struct Asked {
    began: Instant,
    ended: Instant,
    generation: u64,
}

/// Runs the measurement.
///
/// # Errors
/// [`RobotError`].
pub fn run(options: &PauseOptions) -> Result<PauseReport, RobotError> {
    let PauseOptions { n_gaussians, dim, n_fetches, idle, .. } = *options;
    let generator = Generator { n_gaussians, dim, key: generate_key() };
    let shelf = Shelf::default();
    let put = |generation| -> io::Result<()> {
        let published = generator.generation(generation)?;
        *shelf.write().unwrap_or_else(PoisonError::into_inner) = published;
        Ok(())
    };
    put(1)?;
    let robot = Robot::start(&shelf, dim, &options.work_dir)?;
    robot.fetch()?;

    let (is_over, asked) = (AtomicBool::new(false), Mutex::new(Vec::<Asked>::new()));
    let (mut fetches, mut publishings) = (Vec::new(), Vec::new());
    let mut bytes = 0;
    let mut work = || -> Result<(), RobotError> {
        std::thread::sleep(idle);
        for generation in 2..u64::from(n_fetches) + 2 {
            let publishing = Instant::now();
            put(generation)?;
            let began = Instant::now();
            publishings.push((publishing, began));
            bytes += robot.fetch()?;
            fetches.push((began, Instant::now()));
        }
        Ok(())
    };
    let (worked, queried) = std::thread::scope(|scope| {
        let client = scope.spawn(|| ask_until(&is_over, &robot.service, &asked));
        let worked = work();
        is_over.store(true, Ordering::Relaxed);
        (worked, client.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    });
    robot.end()?;
    worked?;
    queried?;

    let asked = asked.into_inner().unwrap_or_else(PoisonError::into_inner);
    let (mut quiet, mut busy) = (Times::default(), Times::default());
    for query in &asked {
        let during = |(began, ended): &(Instant, Instant)| query.began < *ended && query.ended > *began;
        if fetches.iter().any(during) {
            busy.add(query.ended - query.began);
        } else if !publishings.iter().any(during) {
            // Publishing is the cloud's work, not the robot's: queries during it are not counted.
            quiet.add(query.ended - query.began);
        }
    }
    let mut fetch_ms: Vec<f64> =
        fetches.iter().map(|(began, ended)| (*ended - *began).as_secs_f64() * 1e3).collect();
    let generations: std::collections::BTreeSet<u64> = asked.iter().map(|query| query.generation).collect();
    let fetching = busy.percentiles();
    Ok(PauseReport {
        machine: Machine::here(),
        n_gaussians,
        dim,
        n_fetches,
        bytes_per_fetch: bytes / u64::from(n_fetches.max(1)),
        fetch_median_ms: quantile(&mut fetch_ms, 500),
        idle: quiet.percentiles(),
        fetching,
        longest_pause_ms: fetching.max_ms,
        n_generations_seen: generations.len(),
    })
}

/// Sends one query after the other, without a pause.
fn ask_until(is_over: &AtomicBool, service: &str, asked: &Mutex<Vec<Asked>>) -> Result<(), RobotError> {
    let agent: ureq::Agent = ureq::Agent::config_builder().proxy(None).build().into();
    let fail = |e: &dyn ToString| RobotError::Query { what: e.to_string() };
    for number in 0u64.. {
        if is_over.load(Ordering::Relaxed) {
            break;
        }
        let url = format!("{service}/query?text={}", number % 8);
        let began = Instant::now();
        let body = agent.get(&url).call().and_then(|mut answer| answer.body_mut().read_to_string());
        let body: serde_json::Value =
            serde_json::from_str(&body.map_err(|e| fail(&e))?).map_err(|e| fail(&e))?;
        let generation = body["generation"].as_u64().ok_or_else(|| fail(&"no generation"))?;
        if body["n_matching"].as_u64().is_none_or(|n| n == 0) {
            return Err(fail(&"nothing was found"));
        }
        let query = Asked { began, ended: Instant::now(), generation };
        asked.lock().unwrap_or_else(PoisonError::into_inner).push(query);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every query is answered, by each generation in turn. (Times are reported, not asserted.)
    #[test]
    fn queries_go_on_during_fetches() {
        let dir = tempfile::tempdir().expect("a folder");
        let options = PauseOptions {
            n_gaussians: 140_000,
            dim: 32,
            n_fetches: 3,
            idle: Duration::from_millis(50),
            work_dir: dir.path().into(),
        };
        let report = run(&options).expect("measures");
        assert!(report.fetching.n > 0 && report.idle.n > 0 && report.longest_pause_ms > 0.0, "{report:?}");
        assert!(report.n_generations_seen >= 3, "{report:?}");
        // Three cells: one or two of them change.
        assert!(report.bytes_per_fetch > 6 * 65_536, "{report:?}");
    }
}
