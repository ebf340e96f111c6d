//! The last step: the manifest is signed and becomes the store's current generation.

use std::collections::BTreeMap;
use std::io;
use std::time::Instant;

use slag_common::Hash32;
use slag_common::manifest::{self, Calibration, EncoderRecord, Manifest, ObjectRecord, TextModelRecord};
use slag_common::shard::ScoreErrors;
use slag_models::ModelDir;

use super::cells::{BuiltCells, FinishedCell};
use super::error::EncodeError;
use super::plan::Plan;
use super::report::{CellReport, EncodeSummary};
use super::settings::Masks;
use super::views::{DoneViews, Executor};
use crate::ingest;
use crate::store::{ModelsRecord, Store};

/// Publishes the built cells, ends the job and returns the summary.
///
/// # Errors
/// [`EncodeError::Store`]; the current generation then stays.
pub(super) fn publish(
    plan: Plan<'_>,
    views: DoneViews<'_>,
    built: BuiltCells,
    executor: &dyn Executor,
) -> Result<EncodeSummary, EncodeError> {
    let n_gaussians = plan.inputs.scene.len() - plan.inputs.split.n_rejected;
    if built.n_without_evidence() >= n_gaussians as u64 && !plan.settings.run.allow_empty {
        let BuiltCells { n_views_without_masks, n_masks, n_entries, .. } = built;
        let n_views = views.used.len();
        return Err(EncodeError::Failed(format!(
            "no Gaussian has an embedding, so nothing is published: {n_views} views ({n_views_without_masks} without masks) \
             have {n_masks} masks and {n_entries} contributions; see whether masks, poses and splat fit with `slag-encoder \
             check`, or publish it all the same with --allow-empty"
        )));
    }
    warn_of_single_masks(&plan, &built, views.used.len());
    let generation = plan.store.next_generation()?;
    let text_model = plan
        .settings
        .output
        .text_model
        .then(|| carry_text_model(plan.store, plan.engines.models))
        .transpose()?;
    let manifest = manifest(&plan, &built, generation, text_model);
    executor.begin_publication()?;
    plan.store.publish(&manifest, &built.extras)?;
    let mut summary = summary(&plan, &views, built, &manifest);
    let context = plan.context;
    // With views left to do, contributions stay for the next encode.
    let has_open = views.records.len() + views.run.skipped.len() < plan.inputs.views.len();
    let store = plan.store;
    if let Err(error) = tidy_up(plan, has_open, manifest.encoder.id) {
        let path = store.dir().display();
        tracing::warn!("generation {generation} is published, but {path} was not tidied up: {error}");
    }
    summary.busy_secs = context.busy_secs();
    for stage in &summary.view_stages {
        *summary.busy_secs.entry(stage.stage.clone()).or_default() += stage.busy_secs;
    }
    let end = Instant::now();
    summary.wall_secs = end.duration_since(context.start).as_secs_f64();
    summary.phases = context.phases(end);
    Ok(summary)
}

/// Records the models, ends the job, and removes what no generation needs.
fn tidy_up(plan: Plan<'_>, has_open: bool, encoder: Hash32) -> Result<(), EncodeError> {
    let models = plan.settings.output.models.clone();
    plan.store.remember_models(&ModelsRecord { encoder, models })?;
    if plan.settings.run.keep_views || has_open {
        plan.job.keep_published()?
    } else {
        plan.job.clear()?
    }
    plan.store.prune()?;
    Ok(())
}

/// Copies the models' text side into the store, unless it is there; robots fetch it with the scene.
fn carry_text_model(store: &Store, models: &ModelDir) -> Result<TextModelRecord, EncodeError> {
    let text_side = models.text_side()?;
    let mut files = Vec::new();
    for file in text_side.files() {
        let copied = store.put_object(|out| io::copy(&mut file.reader()?, out).map(drop));
        let (hash, len_bytes) = copied?;
        files.push(ObjectRecord { hash, len_bytes });
    }
    let names: Vec<_> = files.iter().map(|file| file.hash).collect();
    let (hash, len_bytes) = store.put_bytes(&text_side.description(&names)?)?;
    Ok(TextModelRecord { description: ObjectRecord { hash, len_bytes }, files })
}

/// Warns of given masks that look like a trainer's, which say what to keep or ignore.
fn warn_of_single_masks(plan: &Plan<'_>, built: &BuiltCells, n_views: usize) {
    let is_given = matches!(plan.settings.view.masks, Masks::Given { .. });
    let n_with_masks = n_views - built.n_views_without_masks;
    if is_given && n_with_masks > 1 && built.n_masks == n_with_masks {
        tracing::warn!(
            "each photo has one mask, as if of what to keep or ignore; objects need a mask for each thing"
        );
    }
}

fn manifest(
    plan: &Plan<'_>,
    built: &BuiltCells,
    generation: u64,
    text_model: Option<TextModelRecord>,
) -> Manifest {
    let (settings, inputs, models) = (plan.settings, plan.inputs, plan.engines.models);
    // Robots accept scores from three spreads above the mean on.
    let of_calibration = || {
        let Calibration { score_mean, score_spread } = built.calibration();
        (score_mean + 3.0 * score_spread).clamp(-1.0, 1.0)
    };
    Manifest {
        version: manifest::VERSION,
        scene: settings.output.scene_name.clone(),
        generation,
        created_unix_secs: settings.output.created_unix_secs,
        metric: settings.inputs.metric || inputs.geo_reference.is_some(),
        geo_reference: inputs.geo_reference,
        encoder: EncoderRecord {
            name: models.encoder_id().name.clone(),
            id: Hash32(models.encoder_id().hash()),
            dim: models.dim() as u32,
            default_threshold: models.threshold().unwrap_or_else(of_calibration),
            calibration: models.threshold().is_none().then(|| built.calibration()),
            text_model,
        },
        n_gaussians: (inputs.scene.len() - inputs.split.n_rejected) as u64,
        n_without_evidence: built.n_without_evidence(),
        n_rejected: inputs.split.n_rejected as u64,
        cells: built.cells.iter().map(|cell| cell.record.clone()).collect(),
    }
}

fn summary(plan: &Plan<'_>, views: &DoneViews<'_>, built: BuiltCells, manifest: &Manifest) -> EncodeSummary {
    let cells: Vec<CellReport> = built.cells.iter().zip(&built.n_entries_of_cell).map(cell_report).collect();
    let mut shard_bytes: BTreeMap<String, u64> = BTreeMap::new();
    for (profile, len_bytes) in cells.iter().flat_map(|cell| &cell.shard_bytes) {
        *shard_bytes.entry(profile.clone()).or_default() += len_bytes;
    }
    EncodeSummary {
        generation: manifest.generation,
        n_gaussians: manifest.n_gaussians,
        n_without_evidence: built.n_without_evidence(),
        n_rejected: manifest.n_rejected,
        n_views: views.used.len(),
        n_views_with_photo: plan.inputs.views.len(),
        n_views_drawn: ingest::n_drawn(views.used.iter().copied()),
        unit: if manifest.metric { "m" } else { "world units" },
        view_order: plan.settings.run.view_order,
        coverage: views.coverage,
        coverage_secs: plan.coverage_secs,
        n_views_resumed: views.n_resumed,
        lost_views: plan.lost_views.clone(),
        encoder_before: plan.encoder_before.clone(),
        n_unlike: plan.n_unlike,
        n_views_without_masks: built.n_views_without_masks,
        skipped_views: views.skipped.clone(),
        n_masks: built.n_masks,
        n_regions: built.n_regions,
        n_entries: built.n_entries,
        n_cells: cells.len(),
        n_centroids: cells.iter().map(|cell| u64::from(cell.n_centroids)).sum(),
        objects: built.objects,
        occupancy: built.occupancy,
        shard_bytes,
        cells,
        views: built.views,
        busy_secs: BTreeMap::new(),
        view_stages: views.run.stages.clone(),
        phases: Vec::new(),
        views_secs: views.secs,
        wall_secs: 0.0,
        images_on: views.run.images_on.clone(),
        encoder: plan.engines.models.encoder_id().to_string(),
    }
}

/// Mean error relative to the spread; one Gaussian, or equal ones, have none.
fn relative_error(errors: &ScoreErrors) -> Option<f32> {
    (errors.spread > f32::EPSILON).then(|| errors.mean / errors.spread)
}

fn cell_report((cell, n_entries): (&FinishedCell, &u64)) -> CellReport {
    let record = &cell.record;
    let shards = || record.shards.iter().map(|(profile, shard)| (profile.to_string(), shard));
    CellReport {
        cell_id: record.cell_id,
        n_gaussians: record.n_gaussians,
        n_entries: *n_entries,
        n_centroids: record.shards.values().map(|shard| shard.n_centroids).max().unwrap_or(0),
        n_subspaces: cell.n_subspaces,
        shard_bytes: shards().map(|(profile, shard)| (profile, shard.len_bytes)).collect(),
        score_error: shards()
            .filter_map(|(profile, shard)| Some((profile, relative_error(&shard.score_errors)?)))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_gaussian_has_no_relative_error() {
        let of = |mean, spread| relative_error(&ScoreErrors { mean, spread, ..ScoreErrors::default() });
        assert_eq!([of(0.25, 0.5), of(0.25, 0.0), of(0.25, 1e-9)], [Some(0.5), None, None]);
    }
}
