//! `push`: copies a store into a vector database.

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;
use clap::{Args, Subcommand};

use super::common::{print, runtime, stopped};
use super::exit::Exit;
use crate::progress::Progress;
use crate::publish::qdrant;
use crate::store::Store;

/// `push`.
#[derive(Debug, Subcommand)]
pub enum PushCommand {
    /// Pushes every embedding with its position to a Qdrant collection; resumes where it stopped.
    Qdrant(QdrantArgs),
}

/// `push qdrant`.
#[derive(Debug, Args)]
pub struct QdrantArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Qdrant's gRPC address.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:6334")]
    pub url: String,
    /// Collection; created if it does not exist.
    #[arg(long, value_name = "NAME")]
    pub collection: String,
    /// API key.
    #[arg(long, value_name = "KEY", env = "QDRANT_API_KEY", hide_env_values = true)]
    pub api_key: Option<String>,
    /// Points per request.
    #[arg(long, value_name = "N", default_value = "256")]
    pub batch: NonZeroUsize,
}

pub(super) fn run(args: &QdrantArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let options = qdrant::PushOptions {
        api_key: args.api_key.clone(),
        n_points_per_batch: args.batch,
        ..qdrant::PushOptions::new(&args.url, &args.collection)
    };
    // A push keeps its state in the store, so it takes the writer's lock.
    let store = Store::create_or_open(&args.store)?;
    let reader = store.reader()?;
    let vectors = Arc::new(qdrant::ExactShards::new(reader.clone()));
    let mut shown = None;
    let on_batch = |at: qdrant::PushProgress| {
        let before = shown.replace(at.n_points);
        match before {
            None => progress.begin("push", "point", at.n_points_expected, at.n_points),
            Some(before) => progress.advance(at.n_points - before),
        }
    };
    let pushed =
        runtime()?.block_on(qdrant::push(&reader, vectors, store.db(), &options, on_batch, stopped()));
    progress.end();
    let report = pushed?;
    let lines = format!(
        "{} points in collection {}: {} sent now, {} Gaussians without evidence left out, {} attempts repeated\n",
        report.n_points, args.collection, report.n_sent, report.n_without_evidence, report.n_retries
    );
    print(json, &report, lines)?;
    Ok(Exit::Done)
}
