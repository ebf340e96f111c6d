//! The preset `plain` beside the default, on labelled scenes, with true and with automatic masks, by Gaussian and by
//! object: the figures that a default is chosen and judged by.

use std::fmt;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use serde::Serialize;
use slag_models::{ModelDir, SessionOptions};

use super::instances::InstanceReport;
use super::labelled::labelled;
use super::labelled_scene::{CompareError, LabelledScene};
use super::settings::{EvalKind, EvalSettings};
use slag_encoder::encode::{self, DEFAULT_MASK_LEVELS, EncodeSettings, Engines, Masks, Preset};
use slag_encoder::lift::Aggregation;
use slag_encoder::progress::Silent;
use slag_encoder::raster::{CpuRasterizer, Rasterizer};
use slag_encoder::store::StoreReader;

/// What to compare.
#[derive(Clone, Debug)]
pub struct DefaultsSettings {
    /// Labelled scenes.
    pub scenes: Vec<PathBuf>,
    /// Folder for the stores; a later run reuses the views there.
    pub out: PathBuf,
    /// The default's settings; the comparison sets inputs, masks and store, and what `plain` does otherwise.
    pub encode: EncodeSettings,
}

/// Where masks come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskSource {
    /// The labels.
    Given,
    /// The built-in segmenter.
    Automatic,
}

/// Figures of one scene with one source of masks.
#[derive(Clone, Debug, Serialize)]
pub struct DefaultsRow {
    /// The scene's folder name.
    pub scene: String,
    /// Where masks came from.
    pub masks: MaskSource,
    /// Whether it is the default rather than the preset `plain`.
    pub is_default: bool,
    /// What was scored.
    pub kind: EvalKind,
    /// Mean intersection over union of the argmax over all categories.
    pub miou: Option<f64>,
    /// The same, with words compared by how near a score is to the word's own best ones.
    pub miou_by_own_best: Option<f64>,
    /// Mean average precision over words.
    pub average_precision: Option<f64>,
    /// Mean area under the ROC curve over words.
    pub area_under_roc: Option<f64>,
    /// Instance recall, by object.
    pub instances: Option<InstanceReport>,
    /// Seconds of the encode; few, where the views were there already.
    pub encode_secs: f64,
}

/// The table.
#[derive(Clone, Debug, Serialize)]
pub struct DefaultsReport {
    /// The encoder.
    pub encoder: String,
    /// The default.
    pub aggregation: Aggregation,
    /// By scene, masks, method and kind.
    pub rows: Vec<DefaultsRow>,
}

/// Makes the table and calls `on_row` once a row is measured.
///
/// # Errors
/// [`CompareError`].
pub fn run(
    settings: &DefaultsSettings,
    (models, session): (&ModelDir, &SessionOptions),
    rasterizer: &dyn Rasterizer,
    on_row: &mut dyn FnMut(&DefaultsRow),
    cancel: &AtomicBool,
) -> Result<DefaultsReport, CompareError> {
    let mut text = models.text_encoder(session)?;
    let mut rows = Vec::new();
    for dir in &settings.scenes {
        let scene = LabelledScene::open(dir, &settings.encode.inputs)?;
        for source in [MaskSource::Given, MaskSource::Automatic] {
            let (masks, masks_name) = match source {
                MaskSource::Given => (scene.true_masks(), "given"),
                MaskSource::Automatic => (Masks::Auto { n_levels: DEFAULT_MASK_LEVELS }, "automatic"),
            };
            for is_default in [false, true] {
                let store = settings.out.join(&scene.name).join(masks_name).join(method_name(is_default));
                let mut encode = scene.encode_settings(&settings.encode, store)?;
                encode.view.masks = masks.clone();
                if !is_default {
                    let plain = Preset::Plain.choices();
                    encode.aggregation = plain.aggregation;
                    encode.cells.objects = plain.objects;
                    encode.view.raster_width = plain.raster_width;
                    encode.view.regions = plain.regions;
                }
                let engines = Engines::new(models, session, rasterizer);
                let start = std::time::Instant::now();
                encode::encode(&encode, &engines, &Silent, cancel).map_err(Box::new)?;
                let encode_secs = start.elapsed().as_secs_f64();
                let reader = StoreReader::open(&encode.output.store)?;
                let kinds = [EvalKind::Gaussians, EvalKind::Objects];
                for kind in &kinds[..1 + usize::from(is_default)] {
                    let eval = EvalSettings { kind: Some(*kind), ..EvalSettings::default() };
                    let report =
                        labelled(&reader, &scene.truth, &scene.gaussians, &mut *text, &CpuRasterizer, &eval)?;
                    let row = DefaultsRow {
                        scene: scene.name.clone(),
                        masks: source,
                        is_default,
                        kind: *kind,
                        miou: report.multi_class.first().and_then(|all| all.miou),
                        miou_by_own_best: report.multi_class_by_own_best.first().and_then(|all| all.miou),
                        average_precision: report.mean_average_precision,
                        area_under_roc: report.mean_area_under_roc,
                        instances: report.instances,
                        encode_secs,
                    };
                    on_row(&row);
                    rows.push(row);
                }
            }
        }
    }
    Ok(DefaultsReport { encoder: models.encoder_id().to_string(), aggregation: Aggregation::REFINED, rows })
}

/// Returns the name of the default or of the preset that it is compared with.
fn method_name(is_default: bool) -> &'static str {
    if is_default { "default" } else { "plain" }
}

impl fmt::Display for DefaultsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "| scene | masks | aggregation | by | mIoU | by own best | AP | AUC | things found at IoU 0.25, 0.5 | objects that are two things, of all; things split |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|")?;
        for row in &self.rows {
            let show = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
            let masks = match row.masks {
                MaskSource::Given => "given",
                MaskSource::Automatic => "automatic",
            };
            let method = method_name(row.is_default);
            let kind = match row.kind {
                EvalKind::Gaussians => "Gaussian",
                EvalKind::Objects => "object",
            };
            let figures = [row.miou, row.miou_by_own_best, row.average_precision, row.area_under_roc];
            let figures = figures.map(show).join(" | ");
            let found = row.instances.as_ref().map_or(" | ".into(), |found| {
                let InstanceReport { any, n_merged_objects, n_objects, n_split_things, .. } = found;
                format!("{any} | {n_merged_objects} of {n_objects}; {n_split_things}")
            });
            writeln!(f, "| {} | {masks} | {method} | {kind} | {figures} | {found} |", row.scene)?;
        }
        Ok(())
    }
}
