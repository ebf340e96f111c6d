//! The pipeline: photos, poses and a splat in, a published generation of shards out.
//!
//! Views are done by an `Executor` (`views.rs`): this machine, or a fleet. They are independent: a
//! killed encode resumes after the last finished view, if it is the same encode (`inputs.rs`). Later steps read
//! contributions in the order of the views' names, so the store's bytes do not depend on threads, on the order of views
//! or on interruptions.

mod cells;
mod context;
pub mod coverage;
mod error;
pub mod front;
mod inputs;
mod job;
mod pipeline;
mod plan;
mod publish;
mod report;
mod settings;
mod view;
mod views;

use std::sync::atomic::AtomicBool;

use crate::lift::ContributionError;
use crate::memory::Phase;
use crate::progress::Progress;
use crate::store::{Store, StoreError};
use context::RunContext;
use views::Executor;

pub use context::Engines;
pub(crate) use error::EncodeError;
pub(crate) use inputs::count_inputs;
pub(crate) use job::{JobStatus, job_status};
pub use report::EncodeSummary;
#[cfg(feature = "fleet")]
pub(crate) use report::SkippedView;
pub(crate) use report::{GpuReport, StageReport};
pub use settings::Preset;
#[cfg(feature = "fleet")]
pub(crate) use settings::ViewSettings;
pub(crate) use settings::{DEFAULT_CELL_WIDTH_M, InputSettings, MAX_CELL_GAUSSIANS, RasterWidth};
pub use settings::{DEFAULT_MASK_LEVELS, EncodeSettings, Masks, Regions, Restart, ViewOrder, ViewsLimit};

#[cfg(feature = "fleet")]
pub(crate) mod fleet_parts {
    pub(crate) use super::context::RunContext;
    pub(crate) use super::inputs::{OF_A_FLEET, of_scene};
    pub(crate) use super::plan::{Plan, segmenter_of};
    pub(crate) use super::report::LeftOut;
    pub(crate) use super::view::{PhotoSource, ViewRecord, ViewSink, ViewStages, ViewTools};
    pub(crate) use super::views::{Executor, ViewsRun, work_off};
}

/// Encodes a scene into a store and publishes it as the next generation.
///
/// # Errors
/// [`EncodeError`]; the store keeps its current generation, and finished views are not done again.
pub fn encode(
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> Result<EncodeSummary, EncodeError> {
    encode_by(&views::Here, settings, engines, progress, cancel)
}

/// Like [`encode`]; `executor` does the views.
pub(crate) fn encode_by(
    executor: &dyn Executor,
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> Result<EncodeSummary, EncodeError> {
    settings.validate()?;
    let folder = &settings.output.store;
    let is_new = !folder.exists();
    let context = RunContext::new(settings.run.threads, progress, cancel)?;
    let encoded = encode_into(executor, settings, engines, &context).map_err(|error| match error {
        EncodeError::Records(cause) => StoreError::Records { path: folder.join("db"), cause }.into(),
        error => error,
    });
    let is_begun = || ["job", "drawn", "manifest"].iter().any(|name| folder.join(name).exists());
    if encoded.is_err() && is_new && folder.exists() && !is_begun() {
        // A refusal before any work leaves no empty store behind.
        fs_err::remove_dir_all(folder)?;
    }
    encoded
}

fn encode_into(
    executor: &dyn Executor,
    settings: &EncodeSettings,
    engines: &Engines<'_>,
    context: &RunContext<'_>,
) -> Result<EncodeSummary, EncodeError> {
    // First, so that a second encode into the same store fails at once.
    let store = Store::create_or_open(&settings.output.store)?;
    store.check_keys()?;
    if let Some(planned) = &settings.inputs.planned {
        inputs::make(settings, planned, engines, context)?;
    }
    let inputs = inputs::Inputs::read(settings, context)?;
    context.begin_phase(Phase::Plan);
    let plan = plan::plan(settings, engines, &store, &inputs, &executor.rasterizer(engines), context)?;
    context.begin_phase(Phase::Views);
    plan.job.begin("views")?;
    let mut views = views::run_views(&plan, executor)?;
    let occupancy = views::look_around(&plan, &views)?;
    let landmarks = views::find_landmarks(&plan, &views)?;
    context.begin_phase(Phase::Merge);
    plan.job.begin("cells")?;
    let n_views = views.used.len();
    let built = cells::build_cells(&plan, &mut views, occupancy, landmarks);
    let built = built.map_err(|error| match error {
        EncodeError::Contributions(ContributionError::Cancelled) => {
            EncodeError::Interrupted { n_done: n_views, n_views }
        }
        // Checksums of contributions are checked only here; the next encode must not meet the file again.
        EncodeError::Contributions(error) => plan.job.forget_damaged(error),
        error => error,
    })?;
    context.begin_phase(Phase::Publish);
    plan.job.begin("publish")?;
    publish::publish(plan, views, built, executor)
}
