//! `push`: copies a store into a vector database.

use std::fmt::Write;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};

use super::common::{Exit, print, runtime, stopped};
use crate::progress::Progress;
use crate::publish::qdrant;
use crate::store::{Store, StoreReader};

/// `push`.
#[derive(Debug, Subcommand)]
pub enum PushCommand {
    /// Pushes every embedding with its position to Qdrant; resumes where it stopped.
    Qdrant(QdrantArgs),
}

#[derive(Debug, Args)]
pub struct QdrantArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    #[command(flatten)]
    pub options: qdrant::PushOptions,
}

pub(super) fn run(args: &QdrantArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    // A mistyped path must not create a store.
    StoreReader::open(&args.store)?;
    // A push keeps its state in the store, so it takes the writer's lock.
    let store = Store::create_or_open(&args.store)?;
    let reader = store.reader()?;
    let mut shown = None;
    let on_batch = |at: qdrant::PushProgress| {
        let before = shown.replace(at.n_points);
        match before {
            None => progress.begin("push", "point", at.n_points_expected, at.n_points),
            Some(before) => progress.advance(at.n_points - before),
        }
    };
    let pushed = runtime()?.block_on(qdrant::push(&reader, store.db(), &args.options, on_batch, stopped()));
    progress.end();
    let report = pushed?;
    print(json, &report, lines(&args.options, &report))?;
    Ok(Exit::Done)
}

fn lines(options: &qdrant::PushOptions, report: &qdrant::PushReport) -> String {
    let place = match options.layout {
        qdrant::Layout::One => format!("collection {}", options.collection),
        qdrant::Layout::Cells => {
            format!("{} collections {}-cell-ID", report.n_collections, options.collection)
        }
    };
    let mut lines = format!(
        "{} points in {place}: {} sent now, {} Gaussians without evidence left out, {} attempts repeated\n",
        report.n_points, report.n_sent, report.n_without_evidence, report.n_retries
    );
    let mut line = |text: std::fmt::Arguments<'_>| writeln!(lines, "{text}").expect("a string takes text");
    for name in &report.deleted_collections {
        line(format_args!("collection {name} deleted: the scene no longer has this cell"));
    }
    for snapshot in &report.snapshots {
        let sha256 = snapshot.sha256.as_deref().unwrap_or("not stated");
        line(format_args!(
            "snapshot of {}: {}, {} bytes, SHA-256 {sha256}",
            snapshot.collection, snapshot.name, snapshot.size_bytes
        ));
    }
    lines
}
