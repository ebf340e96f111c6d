//! `push`: copies a store into a vector database.

use std::fmt::Write;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};

use super::common::{Exit, print, runtime, stopped};
use crate::progress::Progress;
use crate::publish::qdrant;
use crate::store::Store;

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
    /// Qdrant's gRPC address.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:6334")]
    pub url: String,
    /// Collection; created if it does not exist. With `--layout cells`: NAME-cell-ID for each cell.
    #[arg(long, value_name = "NAME")]
    pub(crate) collection: String,
    /// API key.
    #[arg(long, value_name = "KEY", env = "QDRANT_API_KEY", hide_env_values = true)]
    pub(crate) api_key: Option<String>,
    /// Points per request.
    #[arg(long, value_name = "N", default_value = "256")]
    pub batch: NonZeroUsize,
    /// One collection for the scene, or one for each cell.
    #[arg(long, value_enum, default_value = "one")]
    pub layout: qdrant::Layout,
    /// Makes a snapshot of each collection at the end, on the server's disk.
    #[arg(long)]
    pub(crate) snapshots: bool,
    /// Settings of the collections.
    #[command(flatten)]
    pub index: qdrant::IndexSettings,
}

pub(super) fn run(args: &QdrantArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let options = qdrant::PushOptions {
        api_key: args.api_key.clone(),
        n_points_per_batch: args.batch,
        layout: args.layout,
        index: args.index,
        snapshots: args.snapshots,
        ..qdrant::PushOptions::new(&args.url, &args.collection)
    };
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
    let pushed = runtime()?.block_on(qdrant::push(&reader, store.db(), &options, on_batch, stopped()));
    progress.end();
    let report = pushed?;
    print(json, &report, lines(args, &report))?;
    Ok(Exit::Done)
}

fn lines(args: &QdrantArgs, report: &qdrant::PushReport) -> String {
    let place = match args.layout {
        qdrant::Layout::One => format!("collection {}", args.collection),
        qdrant::Layout::Cells => format!("{} collections {}-cell-ID", report.n_collections, args.collection),
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
