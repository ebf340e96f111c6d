//! `eval defaults`: the preset `plain` beside the default, on labelled scenes, with true and with automatic masks,
//! by Gaussian and by object: the figures that a default is chosen and judged by.

use std::fmt;

use anyhow::Result;
use serde::Serialize;
use slag_common::shard::Profile;
use slag_encoder::encode::Preset;
use slag_encoder::progress::Progress;

use super::judge::{EvalKind, EvalReport, JudgeSettings, judge};
use super::run::{MaskSource, Runner, ScenesArgs, truth_of};
use crate::scenes::SceneFiles;
use crate::table::{Table, figure};

/// Encodes of a scene: given and automatic masks, the plain average and the default.
const N_ENCODES: usize = 4;

#[derive(Clone, Debug, Serialize)]
struct Row {
    scene: String,
    masks: MaskSource,
    method: &'static str,
    n_masks: u64,
    encode_secs: f64,
    #[serde(flatten)]
    report: EvalReport,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct DefaultsReport {
    encoder: String,
    rows: Vec<Row>,
}

pub(crate) fn run(args: &ScenesArgs, progress: &dyn Progress) -> Result<DefaultsReport> {
    let runner = Runner::open(args)?;
    let mut text = runner.text_encoder()?;
    let mut rows = Vec::new();
    let scenes = SceneFiles::find_all(&args.scene)?;
    progress.begin("defaults", "encode", (scenes.len() * N_ENCODES) as u64, 0);
    for files in &scenes {
        for (source, is_default) in MaskSource::ALL.into_iter().flat_map(|s| [(s, false), (s, true)]) {
            let method = if is_default { "default" } else { "plain" };
            let encoded = runner.encode(files, source, method, |settings| {
                settings.cells.shards.profiles = vec![Profile::Exact];
                if !is_default {
                    Preset::Plain.apply(settings);
                }
            })?;
            progress.advance(1);
            let Some(encoded) = encoded else { continue };
            let truth = truth_of(&encoded.reader, &files.dir)?;
            for kind in &[EvalKind::Gaussians, EvalKind::Objects][..1 + usize::from(is_default)] {
                let settings = JudgeSettings { kind: Some(*kind), ..JudgeSettings::default() };
                let report = judge(&encoded.reader, &truth, &mut *text, &settings)?;
                let (source_name, ap) = (source.name(), report.mean_average_precision);
                tracing::info!("{} {source_name} {method}, by {kind}: AP {ap:.4?}", files.name);
                rows.push(Row {
                    scene: files.name.clone(),
                    masks: source,
                    method,
                    n_masks: encoded.summary.n_masks as u64,
                    encode_secs: encoded.secs,
                    report,
                });
            }
        }
    }
    progress.end();
    Ok(DefaultsReport { encoder: runner.encoder_id(), rows })
}

impl fmt::Display for DefaultsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = ["scene", "masks", "method", "by", "mIoU", "AP", "AUC", "found at IoU 0.5"];
        let mut table = Table::new(columns);
        for row in &self.rows {
            let mut cells = vec![row.scene.clone(), row.masks.name().to_owned()];
            let report = &row.report;
            cells.extend([row.method.to_owned(), report.kind.to_string()]);
            cells
                .extend([report.miou, report.mean_average_precision, report.mean_area_under_roc].map(figure));
            cells.extend(report.instances.map(|found| found.to_string()));
            table.row(cells);
        }
        write!(f, "{table}")
    }
}
