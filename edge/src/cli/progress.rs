//! Fetching with the real clock and network: a progress line on the terminal, and reports.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::fetch::{DownloadFailure, Environment, FetchReport, NetworkLimits, Progress, Tally};
use slag_common::ByteSize;

use super::failure::Failure;
use super::output::print_pairs;

pub fn environment<'a>(
    ca: Option<&'a Path>,
    cancel: &'a AtomicBool,
    progress: &'a dyn Progress,
) -> Environment<'a> {
    let (now_unix_secs, limits) = (crate::now_unix_secs(), NetworkLimits::default());
    Environment { now_unix_secs, cancel, progress, random: &random, ca, limits }
}

/// Returns a number in 0..1 that differs between robots, so that a fleet does not retry in step.
pub fn random() -> f64 {
    // The standard library's random hash keys are new for each call.
    (RandomState::new().build_hasher().finish() >> 11) as f64 / (1u64 << 53) as f64
}

pub fn print_report(report: &FetchReport) -> Result<(), Failure> {
    let tally = |t: &Tally| format!("{} shards, {}", t.n_shards, ByteSize(t.bytes));
    let news = match report.is_first_contact {
        true => ", trusted at first contact: compare it with the store's",
        false => "",
    };
    print_pairs(&[
        ("scene", report.scene.clone()),
        ("generation", report.generation.to_string()),
        ("encoder", format!("{} ({})", report.encoder_name, report.encoder_id)),
        ("cells", format!("{} within {} of {:.2}", report.n_cells, report.radius, report.centre_in_world)),
        ("downloaded", format!("{} ({} resumed)", tally(&report.downloaded), ByteSize(report.resumed_bytes))),
        ("kept", tally(&report.kept)),
        ("spare", tally(&report.spare)),
        ("freed", tally(&report.freed)),
        ("seconds", format!("{:.2}", report.seconds)),
        ("trusted by", format!("root {}{news}", report.root_version)),
    ])
}

/// Returns a note on cells that could not be fetched.
pub fn bad_cells(report: &FetchReport) -> Option<String> {
    if report.bad_cells.is_empty() {
        return None;
    }
    let cells: Vec<String> = report.bad_cells.iter().map(ToString::to_string).collect();
    Some(format!(
        "{} of {} cells could not be fetched: {}; all others are on board. Have the scene published again, and fetch again",
        cells.len(),
        report.n_cells,
        cells.join(", ")
    ))
}

/// Prints a fetch as one line, for a followed robot.
pub fn print_line(report: &FetchReport) -> Result<(), Failure> {
    let FetchReport { generation, n_cells, centre_in_world, downloaded, freed, .. } = report;
    let (came, went) = (downloaded.n_shards, freed.n_shards);
    writeln!(
        io::stdout(),
        "generation {generation}, {n_cells} cells around {centre_in_world}: {came} shards fetched, {went} freed"
    )?;
    if let Some(what) = bad_cells(report) {
        tracing::warn!("{what}");
    }
    Ok(())
}

#[derive(Default)]
pub struct Bar {
    shown: bool,
    planned_bytes: AtomicU64,
    received_bytes: AtomicU64,
}

impl Bar {
    pub fn new(shown: bool) -> Self {
        Self { shown, ..Self::default() }
    }

    pub fn finish(&self) {
        if self.shown && self.planned_bytes.load(Ordering::Relaxed) > 0 {
            let _ = writeln!(io::stderr());
        }
    }
}

impl Progress for Bar {
    fn planned(&self, bytes: u64) {
        self.planned_bytes.store(bytes, Ordering::Relaxed);
    }

    fn received(&self, bytes: u64) {
        let received = self.received_bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let planned = self.planned_bytes.load(Ordering::Relaxed);
        if self.shown {
            // As wide as the longest size, to overwrite the previous line.
            let _ = write!(io::stderr(), "\r{:>8} of {:>8} ", ByteSize(received), ByteSize(planned));
        }
    }

    fn retried(&self, url: &str, failure: &DownloadFailure) {
        tracing::warn!("{url}: {failure}; retrying");
    }
}
