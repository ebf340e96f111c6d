//! `eval defaults`: the preset `plain` beside the default, on labelled scenes, with true and with automatic masks,
//! by Gaussian and by object: the figures that a default is chosen and judged by.

use std::fmt;

use anyhow::Result;
use serde::Serialize;
use slag_common::shard::Profile;
use slag_encoder::encode::Preset;
use slag_encoder::progress::Progress;

use super::instances::InstanceReport;
use super::judge::{EvalKind, JudgeSettings, judge};
use super::run::{MaskSource, Runner, ScenesArgs, truth_of};
use crate::scenes::SceneFiles;
use crate::table::{Table, figure, percent};

/// Encodes of a scene: given and automatic masks, the plain average and the default.
const N_ENCODES: usize = 4;

#[derive(Clone, Debug, Serialize)]
struct Row {
    scene: String,
    masks: MaskSource,
    method: &'static str,
    kind: EvalKind,
    miou: Option<f64>,
    average_precision: Option<f64>,
    area_under_roc: Option<f64>,
    /// Absent categories that found nothing, of all.
    abstained: [usize; 2],
    instances: Option<InstanceReport>,
    n_masks: u64,
    encode_secs: f64,
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
                let average_precision = report.mean_average_precision;
                tracing::info!(
                    "{} {} {method}, by {kind}: AP {average_precision:.4?}",
                    files.name,
                    source.name()
                );
                rows.push(Row {
                    scene: files.name.clone(),
                    masks: source,
                    method,
                    kind: *kind,
                    miou: report.multi_class.first().and_then(|all| all.miou),
                    average_precision,
                    area_under_roc: report.mean_area_under_roc,
                    abstained: report.abstained,
                    instances: report.instances,
                    n_masks: encoded.summary.n_masks as u64,
                    encode_secs: encoded.secs,
                });
            }
        }
    }
    progress.end();
    Ok(DefaultsReport { encoder: runner.encoder_id(), rows })
}

impl fmt::Display for DefaultsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = ["scene", "masks", "method", "by", "mIoU", "AP", "AUC"];
        let of_things = [
            "found at IoU 0.25 and 0.5",
            "objects that are two things",
            "things split",
            "Gaussians in objects",
        ];
        let mut table = Table::new(columns.into_iter().chain(of_things));
        for row in &self.rows {
            let mut cells = vec![row.scene.clone(), row.masks.name().to_owned()];
            cells.extend([row.method.to_owned(), row.kind.to_string()]);
            cells.extend([row.miou, row.average_precision, row.area_under_roc].map(figure));
            if let Some(found) = &row.instances {
                let InstanceReport { any, n_merged_objects, n_objects, n_in_objects, n_split_things, .. } =
                    found;
                cells.push(any.to_string());
                cells.extend([format!("{n_merged_objects} of {n_objects}"), n_split_things.to_string()]);
                cells.push(percent(n_in_objects[0] as u64, n_in_objects[1] as u64));
            }
            table.row(cells);
        }
        write!(f, "{table}")
    }
}
