//! Accuracy of each aggregation method against errors in the masks. True masks are damaged ([`MaskNoise`]), encoded once
//! per level of noise, and lifted once per method.

use std::fmt;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use serde::Serialize;
use slag_models::{ModelDir, SessionOptions};

use super::labelled::labelled;
use super::labelled_scene::{CompareError, LabelledScene};
use super::mask_noise::MaskNoise;
use super::metrics::mean;
use super::settings::EvalSettings;
use slag_encoder::encode::{self, EncodeSettings, Engines, Perturbation};
use slag_encoder::lift::Aggregation;
use slag_encoder::progress::Silent;
use slag_encoder::raster::{CpuRasterizer, Rasterizer};
use slag_encoder::store::StoreReader;

/// What to compare.
#[derive(Clone, Debug)]
pub struct NoiseSettings {
    /// Labelled scenes.
    pub scenes: Vec<PathBuf>,
    /// Levels of noise; if empty, masks come unchanged from the segmenter that `encode` names.
    pub levels: Vec<u8>,
    /// Seed of the errors.
    pub seed: u64,
    /// Aggregation methods with their names.
    pub methods: Vec<(String, Aggregation)>,
    /// Folder for the stores; a later run reuses the views there.
    pub out: PathBuf,
    /// All other settings; the comparison sets scene, views, masks and store.
    pub encode: EncodeSettings,
}

/// Figures of one method on one scene at one level.
#[derive(Clone, Debug, Serialize)]
pub struct NoiseRow {
    /// The scene's folder name.
    pub scene: String,
    /// Level of the errors; absent for the segmenter's masks.
    pub level: Option<u8>,
    /// Name of the method.
    pub method: String,
    /// Mean intersection over union of the argmax over all categories.
    pub miou: Option<f64>,
    /// Mean accuracy of the same argmax.
    pub macc: Option<f64>,
    /// Mean average precision over words.
    pub average_precision: Option<f64>,
    /// Seconds to refine and to compute embeddings.
    pub refine_secs: f64,
}

/// The table.
#[derive(Clone, Debug, Serialize)]
pub struct NoiseReport {
    /// The encoder.
    pub encoder: String,
    /// Seed of the errors.
    pub seed: u64,
    /// The methods.
    pub methods: Vec<(String, Aggregation)>,
    /// Figures of each scene, level and method.
    pub rows: Vec<NoiseRow>,
}

/// Makes the table and passes each row to `on_row` once it is measured.
///
/// # Errors
/// [`CompareError`].
pub fn run(
    settings: &NoiseSettings,
    (models, session): (&ModelDir, &SessionOptions),
    rasterizer: &dyn Rasterizer,
    on_row: &mut dyn FnMut(&NoiseRow),
    cancel: &AtomicBool,
) -> Result<NoiseReport, CompareError> {
    let mut text = models.text_encoder(session)?;
    let mut rows = Vec::new();
    let levels: Vec<Option<u8>> = match settings.levels.is_empty() {
        true => vec![None],
        false => settings.levels.iter().copied().map(Some).collect(),
    };
    for dir in &settings.scenes {
        let scene = LabelledScene::open(dir, &settings.encode.inputs)?;
        for level in &levels {
            let folder =
                level.map_or("as-found".into(), |level| format!("level-{level}-seed-{}", settings.seed));
            let store = settings.out.join(&scene.name).join(folder);
            let mut encode = scene.encode_settings(&settings.encode, store)?;
            if level.is_some() {
                encode.view.masks = scene.true_masks();
            }
            for (method, aggregation) in &settings.methods {
                encode.aggregation = *aggregation;
                let noise = level.map(|level| MaskNoise { level, seed: settings.seed });
                let perturbation = noise.as_ref().map(|noise| noise as &dyn Perturbation);
                let engines = Engines { perturbation, ..Engines::new(models, session, rasterizer) };
                let summary = encode::encode(&encode, &engines, &Silent, cancel).map_err(Box::new)?;
                let reader = StoreReader::open(&encode.output.store)?;
                let eval = EvalSettings::default();
                let report =
                    labelled(&reader, &scene.truth, &scene.gaussians, &mut *text, &CpuRasterizer, &eval)?;
                let secs = |stage: &str| summary.busy_secs.get(stage).copied().unwrap_or(0.0);
                let all_classes = report.multi_class.first();
                let row = NoiseRow {
                    scene: scene.name.clone(),
                    level: *level,
                    method: method.clone(),
                    miou: all_classes.and_then(|all| all.miou),
                    macc: all_classes.and_then(|all| all.macc),
                    average_precision: report.mean_average_precision,
                    refine_secs: secs("superpoints") + secs("refine") + secs("lift"),
                };
                on_row(&row);
                rows.push(row);
            }
        }
    }
    let encoder = models.encoder_id().to_string();
    Ok(NoiseReport { encoder, seed: settings.seed, methods: settings.methods.clone(), rows })
}

impl fmt::Display for NoiseReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut levels: Vec<Option<u8>> = self.rows.iter().map(|row| row.level).collect();
        levels.sort_unstable();
        levels.dedup();
        let heads = levels.iter().map(|level| level.map_or("as found".into(), |l| format!("level {l}")));
        writeln!(f, "mIoU / mAcc, mean over scenes; errors of seed {}", self.seed)?;
        writeln!(f, "{:<14}{}", "method", heads.map(|head| format!("{head:>16}")).collect::<String>())?;
        for (method, _) in &self.methods {
            let figure = |level: &Option<u8>| {
                let rows = || self.rows.iter().filter(|row| row.method == *method && row.level == *level);
                let show = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
                let (miou, macc) = (mean(rows().map(|row| row.miou)), mean(rows().map(|row| row.macc)));
                format!("{:>16}", format!("{} / {}", show(miou), show(macc)))
            };
            writeln!(f, "{method:<14}{}", levels.iter().map(figure).collect::<String>())?;
        }
        Ok(())
    }
}
