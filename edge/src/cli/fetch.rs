//! `fetch`.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{self, IsTerminal, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use slag_edge::fetch::Failure as DownloadFailure;
use slag_edge::fetch::{
    self, Environment, FetchError, FetchReport, FetchRequest, NetworkLimits, Position, Progress,
};

use super::FetchArgs;
use super::output::{Failure, print_json, print_pairs};

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
        key: args.key,
        max_bytes: args.max_bytes,
        ..FetchRequest::default()
    };
    let cancel = Arc::new(AtomicBool::new(false));
    let on_signal = Arc::clone(&cancel);
    ctrlc::set_handler(move || on_signal.store(true, Ordering::Relaxed))
        .map_err(|e| Failure::Failed("signals", e.into()))?;
    let bar = Bar { shown: !quiet && !args.json && io::stderr().is_terminal(), ..Bar::default() };
    let environment = Environment {
        now_unix_secs: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs()),
        cancel: &cancel,
        progress: &bar,
        random: &random,
        limits: NetworkLimits::default(),
    };
    let result = fetch::fetch(&args.cache.open()?, &request, &environment);
    bar.finish();
    match result {
        Ok(report) if args.json => print_json(&report),
        Ok(report) => print_report(&report),
        Err(error @ FetchError::Cancelled) => Err(Failure::Interrupted(error.into())),
        Err(error) => Err(Failure::Failed("fetch", error.into())),
    }
}

/// Returns a number in 0..1 that differs from robot to robot, so that a fleet does not retry in step.
fn random() -> f64 {
    // The standard library's per-process random keys; each call has new ones.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}

fn print_report(report: &FetchReport) -> Result<(), Failure> {
    let tally = |t: &fetch::Tally| format!("{} shards, {} bytes", t.n_shards, t.bytes);
    let trust = if report.is_first_contact { " (first contact: compare it with the store's)" } else { "" };
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
