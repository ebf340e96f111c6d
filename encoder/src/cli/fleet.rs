//! The flags of a fleet, and `worker`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_models::commands;
use slag_models::gpus::GpuChoice;

use super::common::{Exit, ModelArgs, cancel_flag, n_threads, open_models, print};
use super::memory::{default_memory_bytes, parse_memory};
use crate::blobs::Bucket;
use crate::encode::{self, EncodeSettings, EncodeSummary, Engines};
use crate::fleet::{Coordinator, Dispatch, QueueSettings, WorkerSettings, parse_period, work};
use crate::progress::{Progress, Silent};
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;

/// `encode` by a fleet.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Fleet")]
pub(crate) struct CoordinatorArgs {
    /// Bucket over which workers do the views: file:///FOLDER that all machines see, or s3://BUCKET/PREFIX,
    /// with credentials in the usual variables. Start `slag-encoder worker` with the same bucket.
    #[arg(long, value_name = "URL", conflicts_with = "time_budget", hide_short_help = true)]
    blobs: Option<String>,
    #[command(flatten)]
    queue: QueueSettings,
}

impl CoordinatorArgs {
    pub(super) fn encode(
        &self,
        settings: &EncodeSettings,
        engines: &Engines<'_>,
        progress: &dyn Progress,
        cancel: &AtomicBool,
    ) -> Result<EncodeSummary> {
        let queue = self.queue.fleet.is_some().then(|| self.queue.clone());
        match &self.blobs {
            Some(url) => {
                let coordinator = Coordinator::new(open_bucket(url)?, queue);
                Ok(encode::encode_by(&coordinator, settings, engines, progress, cancel)?)
            }
            None if queue.is_some() => Err(anyhow!("--fleet needs the bucket of the fleet: give --blobs")),
            None => Ok(encode::encode(settings, engines, progress, cancel)?),
        }
    }
}

#[derive(Debug, Args)]
pub struct WorkerArgs {
    /// Bucket of the fleet, as `encode --blobs` has it.
    #[arg(long, value_name = "URL")]
    blobs: String,
    /// Number of this worker, from 0, where there is no queue.
    #[arg(long, value_name = "I", requires = "of", conflicts_with = "fleet", env = "SLAG_WORKER_INDEX")]
    index: Option<u32>,
    /// Number of workers.
    #[arg(long, value_name = "N", env = "SLAG_WORKER_COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    of: Option<u32>,
    /// Seconds without work after which a worker does what others have left of their shares.
    #[arg(long, value_name = "SECS", default_value = "120", value_parser = parse_period)]
    help_after: Duration,
    #[command(flatten)]
    queue: QueueSettings,
    /// Models, as the coordinator has them.
    #[command(flatten)]
    models: ModelArgs,
    /// Segment Anything, where the coordinator uses it: a folder with model.toml, or the name of a pulled model.
    #[arg(long, value_name = "NAME|DIR")]
    segmenter: Option<PathBuf>,
    /// NVIDIA GPUs for the models, as for `encode`.
    #[arg(long, value_name = "all|N,...", default_value_t)]
    gpus: GpuChoice,
    /// Where weights are rasterised, as for `encode`.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Memory for the scene, photos and lists [default: half of the free memory].
    #[arg(long, value_name = "BYTES", value_parser = parse_memory)]
    memory: Option<u64>,
    /// Folder for photos in work [default: the system's for temporary files].
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// Seconds to wait for an encode to begin, and for a sign of life of the machine that began it.
    #[arg(long, value_name = "SECS", default_value = "600", value_parser = parse_period)]
    wait: Duration,
}

pub(super) fn run(args: &WorkerArgs, json: bool) -> Result<Exit> {
    let dispatch = match (&args.queue.fleet, args.index, args.of) {
        (Some(_), _, _) => Dispatch::Queue(args.queue.clone()),
        (None, Some(index), Some(of)) if index < of => {
            Dispatch::Share { index: index as usize, of: of as usize, help_after: args.help_after }
        }
        (None, Some(index), Some(of)) => {
            return Err(anyhow!("--index {index} --of {of}: workers are numbered from 0 to {}", of - 1));
        }
        (None, _, _) => return Err(anyhow!("give --fleet nats://HOST:PORT, or --index I --of N")),
    };
    let bucket = open_bucket(&args.blobs)?;
    let (models, session) = open_models(&args.models)?;
    let resolve = |name: &PathBuf| commands::resolve(name, &|name| std::env::var_os(name));
    let settings = WorkerSettings {
        dispatch,
        n_threads: n_threads(args.threads),
        gpus: args.gpus.numbers(&session),
        memory_bytes: args.memory.unwrap_or_else(default_memory_bytes),
        folder: args.scratch.clone().unwrap_or_else(std::env::temp_dir),
        segmenter: args.segmenter.as_ref().map(resolve).transpose()?,
        patience: args.wait,
    };
    tracing::info!("models: {} ({})", models.encoder_id(), models.about());
    let devices = Devices::open(&args.device, GpuOptions::default())?;
    let engines = Engines::new(&models, &session, &devices);
    let cancel = cancel_flag()?;
    // The coordinator shows the progress of the fleet.
    let report = work(&bucket, &settings, &engines, &Silent, cancel.as_ref())?;
    let lines = format!("{} runs: {} views done here\n", report.n_runs, report.n_views);
    print(json, &report, lines)?;
    Ok(if cancel.load(Ordering::Relaxed) { Exit::Interrupted } else { Exit::Done })
}

/// Takes credentials from the environment.
pub(super) fn open_bucket(url: &str) -> Result<Arc<Bucket>> {
    // Variables that are not UTF-8 are none of ours.
    let variables =
        std::env::vars_os().filter_map(|(k, v)| Some((k.into_string().ok()?, v.into_string().ok()?)));
    Ok(Arc::new(Bucket::open(url, variables)?))
}
