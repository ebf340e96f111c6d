//! A worker: waits for a run and does its views until all are done.

use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::dispatch::{Dispatcher, Share};
use super::documents::{self, FailedView, RunPlan};
use super::heartbeat::HeartbeatWatch;
use super::prepared::Prepared;
use super::queue::{Queue, QueueSettings};
use super::run::Run;
use super::views::ViewWork;
use crate::blobs::Bucket;
use crate::encode::fleet_parts::{RunContext, segmenter_of};
use crate::encode::{EncodeError, Engines};
use crate::progress::Progress;

/// Pause between checks of a run's state: in a folder, and over a network.
const PAUSES: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(1)];

#[derive(Clone, Debug)]
pub(crate) enum Dispatch {
    /// Every `of`-th, from `index` on; after `help_after` without work, what others left.
    Share {
        /// Number of this worker, from 0.
        index: usize,
        of: usize,
        /// Time to wait for the others.
        help_after: Duration,
    },
    Queue(QueueSettings),
}

#[derive(Clone, Debug)]
pub(crate) struct WorkerSettings {
    pub(crate) dispatch: Dispatch,
    /// Threads, and views worked on at a time.
    pub(crate) n_threads: usize,
    pub(crate) gpus: Vec<u32>,
    pub(crate) memory_bytes: u64,
    /// Folder for photos in work; temporary.
    pub(crate) folder: PathBuf,
    pub(crate) segmenter: Option<PathBuf>,
    /// How long to wait for a run, and for a heartbeat of its coordinator.
    pub(crate) patience: Duration,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct WorkReport {
    pub(crate) n_runs: usize,
    /// Views that it was the first to finish.
    pub(crate) n_views: usize,
}

pub(super) fn pause(bucket: &Bucket) -> Duration {
    PAUSES[usize::from(!bucket.is_local)]
}

pub(crate) fn work(
    bucket: &Arc<Bucket>,
    settings: &WorkerSettings,
    engines: &Engines<'_>,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> Result<WorkReport, EncodeError> {
    let context = RunContext::new(settings.n_threads, progress, cancel)?;
    let mut report = WorkReport::default();
    let mut waiting_since = Instant::now();
    let mut awaits_another = true;
    while !context.is_cancelled() {
        if let Some(run) = Run::open(bucket)? {
            let id = run.0;
            tracing::info!("run {}: {} views", id.0, run.1.views.len());
            work_for(bucket, run, settings, engines, &context, &mut report)?;
            report.n_runs += 1;
            waiting_since = Instant::now();
            awaits_another = id.is_superseded(bucket)?;
        } else if !awaits_another || waiting_since.elapsed() >= settings.patience {
            break;
        } else {
            std::thread::sleep(pause(bucket));
        }
    }
    if report == WorkReport::default() && !context.is_cancelled() && Run::is_first(bucket)? {
        return Err(EncodeError::Failed(format!(
            "{}: no encode began within {:.0} s; check --blobs, or wait longer with --wait",
            bucket.url,
            settings.patience.as_secs_f64()
        )));
    }
    Ok(report)
}

fn work_for(
    bucket: &Arc<Bucket>,
    (run, plan): (Run, RunPlan),
    settings: &WorkerSettings,
    engines: &Engines<'_>,
    context: &RunContext<'_>,
    report: &mut WorkReport,
) -> Result<(), EncodeError> {
    let folder = RunFolder::make(&settings.folder)?;
    let of_scene = plan.of_scene;
    let prepared = Prepared::fetch(bucket, (run, plan), folder.path(), settings.segmenter.as_ref(), context)?;
    let segmenter = segmenter_of(&prepared.settings, &settings.gpus, engines, &prepared.standing)?;
    prepared.check(engines, segmenter.as_ref(), context)?;
    let dispatcher: Box<dyn Dispatcher> = match &settings.dispatch {
        Dispatch::Share { index, of, help_after } => Box::new(Share::new(*index, *of, *help_after)),
        Dispatch::Queue(queue) => {
            let n_held = settings.n_threads + 1;
            Box::new(Queue::open(&bucket.runtime, queue, run, of_scene, n_held)?)
        }
    };
    let scene = context.install(|| engines.rasterizer.load(&prepared.scene))?;
    let work = ViewWork {
        context,
        bucket,
        prepared: &prepared,
        engines,
        segmenter: segmenter.as_ref(),
        scene: scene.as_ref(),
        dispatcher: dispatcher.as_ref(),
        n_threads: settings.n_threads,
        gpus: &settings.gpus,
        n_done: AtomicUsize::new(0),
    };
    prepared.check_memory(settings.memory_bytes, &work.tools())?;
    let result = while_open(&work, HeartbeatWatch::new(run, settings.patience));
    report.n_views += work.n_done.load(Ordering::Relaxed);
    result
}

fn while_open(work: &ViewWork<'_>, mut coordinator: HeartbeatWatch) -> Result<(), EncodeError> {
    let ViewWork { context, bucket, dispatcher, prepared, .. } = *work;
    loop {
        dispatcher.offer(&mut || open_views(bucket, prepared))?;
        work.run()?;
        loop {
            record_failures(bucket, prepared.run, dispatcher)?;
            if context.is_cancelled() || !prepared.run.is_open(bucket)? {
                return Ok(());
            }
            coordinator.check(bucket)?;
            if dispatcher.wait(pause(bucket)) {
                break;
            }
        }
    }
}

/// Views that are neither done nor given up, costly ones first.
fn open_views(bucket: &Bucket, prepared: &Prepared) -> Result<Vec<usize>, EncodeError> {
    let done: BTreeSet<String> = bucket.list("views")?.into_iter().collect();
    let failed = bucket.list(&prepared.run.failed_folder())?;
    let failed: BTreeSet<usize> =
        failed.iter().filter_map(|name| name.strip_suffix(".json")?.parse().ok()).collect();
    let views = prepared.plan.views.iter().enumerate();
    let open =
        views.filter(|(number, view)| !done.contains(&view.id.to_string()) && !failed.contains(number));
    Ok(open.map(|(number, _)| number).collect())
}

/// Records views that ended several workers, so that the run goes on without them.
fn record_failures(bucket: &Bucket, run: Run, dispatcher: &dyn Dispatcher) -> Result<(), EncodeError> {
    for view in dispatcher.take_dead() {
        let reason = "it was given to workers several times, and none left a result; their logs say why";
        let document = documents::to_bytes(&FailedView { reason: reason.into() })?;
        bucket.put_new(&run.failed_key(view), document)?;
        dispatcher.done(view);
    }
    Ok(())
}

/// Prefix of folder names, before the process's number, which is not unique: workers on other machines and in
/// containers may share the parent.
const PREFIX: &str = "slag-worker-";

/// File in each folder that its worker keeps locked.
const LOCK: &str = "lock";

pub(super) struct RunFolder {
    path: PathBuf,
    _lock: File,
}

impl RunFolder {
    /// Makes a folder under `parent`, and removes those of killed workers.
    pub(super) fn make(parent: &Path) -> Result<Self, EncodeError> {
        fs_err::create_dir_all(parent)?;
        remove_left(parent);
        let name = format!("{PREFIX}{}-", std::process::id());
        // Hidden until locked, or a worker that starts now would take it for a leftover.
        let hidden = tempfile::Builder::new().prefix(&format!(".{name}")).tempdir_in(parent)?;
        let lock = File::create_new(hidden.path().join(LOCK))?;
        lock.lock()?;
        let hidden_name = hidden.path().file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = parent.join(hidden_name.trim_start_matches('.'));
        fs_err::rename(hidden.keep(), &path)?;
        Ok(Self { path, _lock: lock })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for RunFolder {
    fn drop(&mut self) {
        if let Err(error) = fs_err::remove_dir_all(&self.path) {
            tracing::warn!("{error}");
        }
    }
}

/// Removes folders whose workers are gone, except those that cannot be read.
fn remove_left(parent: &Path) {
    let Ok(entries) = fs_err::read_dir(parent) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        if !entry.file_name().to_string_lossy().starts_with(PREFIX) {
            continue;
        }
        let Ok(lock) = File::options().write(true).open(path.join(LOCK)) else { continue };
        if lock.try_lock().is_ok() {
            tracing::info!("{}: removed; a worker that was killed left it", path.display());
            if let Err(error) = fs_err::remove_dir_all(&path) {
                tracing::warn!("{error}");
            }
        }
    }
}

#[cfg(test)]
mod tests;
