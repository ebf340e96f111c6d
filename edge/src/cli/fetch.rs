//! `fetch`, and the following of `serve`.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{self, IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::anyhow;
use slag_common::Hash32;
use slag_edge::fetch::follow::{FollowEnvironment, FollowSettings, Following, follow, read_positions};
use slag_edge::fetch::{
    self, DownloadFailure, Environment, FetchError, FetchReport, FetchRequest, NetworkLimits, Position,
    Progress,
};
use slag_edge::http::App;
use slag_edge::store::EdgeCache;

use super::output::{Failure, print_json, print_pairs};
use super::{FetchArgs, FollowArgs, ServeArgs};

/// A second key is the successor's, told beforehand; more are a mistake.
const MAX_KEYS: usize = 2;

pub fn fetch(args: FetchArgs, quiet: bool) -> Result<(), Failure> {
    let at = match (args.at, args.at_geo) {
        (Some(at), _) => Some(Position::World(at)),
        (None, Some((latitude_deg, longitude_deg, height_m))) => {
            Some(Position::Geographic { latitude_deg, longitude_deg, height_m })
        }
        (None, None) => None,
    };
    let request = FetchRequest {
        from: args.from,
        at,
        radius: args.radius,
        profile: args.profile,
        keys: checked_keys(args.key)?,
        max_bytes: args.max_bytes,
        ..FetchRequest::default()
    };
    let settings = args.follow.settings(args.radius)?;
    let cache = args.cache.open()?;
    let cancel = Arc::new(AtomicBool::new(false));
    let on_signal = Arc::clone(&cancel);
    ctrlc::set_handler(move || on_signal.store(true, Ordering::Relaxed))
        .map_err(|e| Failure::Failed("signals", e.into()))?;
    let bar = Bar { shown: !quiet && !args.json && io::stderr().is_terminal(), ..Bar::default() };
    if args.watch {
        return watch(&cache, &request, settings, &cancel, &bar, args.json);
    }
    let result = fetch_once(&cache, &request, &cancel, &bar);
    bar.finish();
    match result {
        Ok(report) if args.json => print_json(&report),
        Ok(report) => print_report(&report),
        Err(error) => Err(failure(error)),
    }
}

fn failure(error: FetchError) -> Failure {
    match error {
        FetchError::Cancelled => Failure::Interrupted(error.into()),
        error => Failure::Failed("fetch", error.into()),
    }
}

fn checked_keys(keys: Vec<Hash32>) -> Result<Vec<Hash32>, Failure> {
    match keys.len() {
        0..=MAX_KEYS => Ok(keys),
        n => Err(Failure::Usage(anyhow!("--key is given {n} times, at most {MAX_KEYS} keys are accepted"))),
    }
}

fn fetch_once(
    cache: &EdgeCache,
    request: &FetchRequest,
    cancel: &AtomicBool,
    progress: &dyn Progress,
) -> Result<FetchReport, FetchError> {
    let environment = Environment {
        now_unix_secs: slag_edge::now_unix_secs(),
        cancel,
        progress,
        random: &random,
        limits: NetworkLimits::default(),
    };
    fetch::fetch(cache, request, &environment)
}

impl FollowArgs {
    fn settings(&self, radius: f64) -> Result<FollowSettings, Failure> {
        let margin = self.margin.unwrap_or(radius / 4.0);
        if !(margin > 0.0 && margin.is_finite()) {
            return Err(Failure::Usage(anyhow!("the margin is {margin}, it must be more than 0")));
        }
        Ok(FollowSettings {
            radius,
            margin,
            min_interval: Duration::from_secs(self.min_interval_secs),
            refresh: (self.refresh_secs > 0).then(|| Duration::from_secs(self.refresh_secs)),
            ..FollowSettings::default()
        })
    }
}

/// Follows the positions on stdin until they end.
fn watch(
    cache: &EdgeCache,
    request: &FetchRequest,
    settings: FollowSettings,
    cancel: &AtomicBool,
    bar: &Bar,
    json: bool,
) -> Result<(), Failure> {
    let following = Arc::<Following>::default();
    if let Some(at) = request.at {
        following.post(at);
    }
    let posting = Arc::clone(&following);
    // Not joined: it may wait for a line that never comes.
    std::thread::Builder::new().name("positions".into()).spawn(move || {
        let read = read_positions(io::stdin().lock(), |line, position| match position {
            Ok(position) => posting.post(position),
            Err(error) => tracing::warn!("line {line}: {error}"),
        });
        if let Err(error) = read {
            tracing::warn!("no more positions can be read: {error}");
        }
        posting.close();
    })?;
    let mut printed = Ok(());
    let followed = follow(
        cache,
        request,
        settings,
        &following,
        FollowEnvironment {
            fetch: &mut |request| fetch_once(cache, request, cancel, bar),
            tell: &mut |outcome| {
                bar.finish();
                let told = match outcome {
                    Ok(report) if json => print_json(report),
                    Ok(report) => print_line(report),
                    Err(error) => {
                        tracing::warn!("{}", slag_edge::error_line(error));
                        Ok(())
                    }
                };
                if told.is_err() {
                    // Nobody reads any more.
                    printed = told;
                    cancel.store(true, Ordering::Relaxed);
                }
            },
            random: &random,
            cancel,
        },
    );
    printed?;
    followed.map_err(failure)
}

/// Follows the positions that the service is told, on a thread of its own, until the flag returned is set.
pub fn follow_in_background(
    args: &ServeArgs,
    cache: EdgeCache,
    following: Arc<Following>,
    app: Arc<App>,
) -> Result<Arc<AtomicBool>, Failure> {
    let request = FetchRequest {
        from: args.follow.clone(),
        profile: args.profile,
        keys: checked_keys(args.key.clone())?,
        max_bytes: args.max_bytes,
        ..FetchRequest::default()
    };
    let settings = args.following.settings(args.radius)?;
    let cancel = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&cancel);
    std::thread::Builder::new().name("follow".into()).spawn(move || {
        let environment = FollowEnvironment {
            fetch: &mut |request| fetch_once(&cache, request, &stop, &()),
            tell: &mut |outcome| match outcome {
                Ok(report) => {
                    let (n, generation) = (report.downloaded.n_shards, report.generation);
                    tracing::info!("{n} shards of generation {generation} came in");
                    app.reload_now();
                }
                Err(error) => tracing::warn!("{}", slag_edge::error_line(error)),
            },
            random: &random,
            cancel: &stop,
        };
        if let Err(error) = follow(&cache, &request, settings, &following, environment) {
            tracing::info!("no longer following: {error}");
        }
    })?;
    Ok(cancel)
}

/// Returns a number in 0..1 that differs from robot to robot, so that a fleet does not retry in step.
fn random() -> f64 {
    // The standard library's per-process random keys; each call has new ones.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}

fn print_report(report: &FetchReport) -> Result<(), Failure> {
    let tally = |t: &fetch::Tally| format!("{} shards, {} bytes", t.n_shards, t.bytes);
    let trust = match report.replaced_key {
        _ if report.is_first_contact => " (first contact: compare it with the store's)",
        Some(_) => " (took the place of the key before, which is no longer accepted)",
        None => "",
    };
    print_pairs(&[
        ("scene", report.scene.clone()),
        ("generation", report.generation.to_string()),
        ("encoder", format!("{} ({})", report.encoder_name, report.encoder_id)),
        ("cells", format!("{} within {} of {}", report.n_cells, report.radius, report.centre_in_world)),
        ("downloaded", format!("{} ({} of them resumed)", tally(&report.downloaded), report.resumed_bytes)),
        ("kept", tally(&report.kept)),
        ("spare", tally(&report.spare)),
        ("freed", tally(&report.freed)),
        ("seconds", format!("{:.2}", report.seconds)),
        ("signed by", format!("{}{trust}", report.key)),
    ])
}

/// Prints a fetch in one line, for a robot that is followed.
fn print_line(report: &FetchReport) -> Result<(), Failure> {
    let FetchReport { generation, n_cells, centre_in_world, downloaded, freed, .. } = report;
    let (came, went) = (downloaded.n_shards, freed.n_shards);
    writeln!(
        io::stdout(),
        "generation {generation}, {n_cells} cells around {centre_in_world}: {came} shards came, {went} went"
    )?;
    Ok(())
}

/// A line on the terminal that says how far the downloads are.
#[derive(Default)]
struct Bar {
    shown: bool,
    planned_bytes: AtomicU64,
    received_bytes: AtomicU64,
}

impl Bar {
    fn finish(&self) {
        if self.shown && self.planned_bytes.load(Ordering::Relaxed) > 0 {
            // Progress that cannot be shown is no reason to stop.
            let _ = writeln!(io::stderr());
        }
    }
}

impl Progress for Bar {
    fn planned(&self, _n_shards: usize, bytes: u64) {
        self.planned_bytes.store(bytes, Ordering::Relaxed);
    }

    fn received(&self, bytes: u64) {
        let received = self.received_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let planned = self.planned_bytes.load(Ordering::Relaxed);
        if self.shown {
            let _ = write!(io::stderr(), "\r{:.1} of {:.1} MB ", received as f64 / 1e6, planned as f64 / 1e6);
        }
    }

    fn retried(&self, url: &str, failure: &DownloadFailure) {
        tracing::warn!("{url}: {failure}; trying again");
    }
}
