//! `eval splat-only`: drawings of planned views beside as many photos, on labelled scenes, with automatic masks.

use std::fmt;

use anyhow::{Context, Result};
use serde::Serialize;
use slag_common::shard::Profile;
use slag_encoder::encode::{EncodeSettings, ViewOrder, ViewsLimit};
use slag_encoder::progress::Progress;
use slag_encoder::viewpoints::{DEFAULT_N_VIEWS, POSES_FILE, ViewpointSettings};
use slag_models::TextEncoder;

use super::judge::{EvalKind, JudgeSettings, judge};
use super::metrics::mean;
use super::run::{MaskSource, Runner, ScenesArgs, truth_of};
use crate::scenes::SceneFiles;
use crate::table::{Table, figure};

#[derive(Clone, Debug, Serialize)]
struct Row {
    scene: String,
    n_views: f64,
    ap_photos: Option<f64>,
    ap_drawn: Option<f64>,
    miou_photos: Option<f64>,
    miou_drawn: Option<f64>,
    /// Things found at IoU 0.5 by any object.
    found_photos: Option<f64>,
    found_drawn: Option<f64>,
    n_things: Option<f64>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct SplatOnlyReport {
    encoder: String,
    scenes: Vec<Row>,
    mean: Row,
}

struct Figures {
    n_views: usize,
    ap: Option<f64>,
    miou: Option<f64>,
    found: Option<f64>,
    n_things: Option<f64>,
}

pub(crate) fn run(args: &ScenesArgs, progress: &dyn Progress) -> Result<SplatOnlyReport> {
    let runner = Runner::open(args)?;
    let mut text = runner.text_encoder()?;
    let scenes = SceneFiles::find_all(&args.scene)?;
    progress.begin("splat only", "encode", 2 * scenes.len() as u64, 0);
    let mut rows = Vec::new();
    for files in &scenes {
        let drawn_at = args.out.join(&files.name).join("drawn").join(POSES_FILE);
        let drawn = figures(&runner, files, "drawings", &mut *text, |settings| {
            settings.inputs.images = None;
            settings.inputs.views = drawn_at;
            settings.inputs.planned = Some(ViewpointSettings { n_views: DEFAULT_N_VIEWS, up: None });
        })?;
        progress.advance(1);
        let photos = figures(&runner, files, "photos", &mut *text, |settings| {
            settings.run.views_limit = ViewsLimit::Count(drawn.n_views);
            settings.run.view_order = ViewOrder::Coverage;
        })?;
        progress.advance(1);
        rows.push(Row {
            scene: files.name.clone(),
            n_views: drawn.n_views as f64,
            ap_photos: photos.ap,
            ap_drawn: drawn.ap,
            miou_photos: photos.miou,
            miou_drawn: drawn.miou,
            found_photos: photos.found,
            found_drawn: drawn.found,
            n_things: drawn.n_things,
        });
    }
    progress.end();
    let of = |figure: fn(&Row) -> Option<f64>| mean(rows.iter().map(figure));
    let mean = Row {
        scene: "mean".into(),
        n_views: of(|row| Some(row.n_views)).unwrap_or_default(),
        ap_photos: of(|row| row.ap_photos),
        ap_drawn: of(|row| row.ap_drawn),
        miou_photos: of(|row| row.miou_photos),
        miou_drawn: of(|row| row.miou_drawn),
        found_photos: of(|row| row.found_photos),
        found_drawn: of(|row| row.found_drawn),
        n_things: of(|row| row.n_things),
    };
    Ok(SplatOnlyReport { encoder: runner.encoder_id(), scenes: rows, mean })
}

/// Encodes a scene and judges it, by Gaussian; things are found by objects.
fn figures(
    runner: &Runner,
    files: &SceneFiles,
    method: &str,
    text: &mut dyn TextEncoder,
    change: impl FnOnce(&mut EncodeSettings),
) -> Result<Figures> {
    let encoded = runner.encode(files, MaskSource::Automatic, method, |settings| {
        settings.cells.shards.profiles = vec![Profile::Exact];
        change(settings);
    })?;
    let encoded = encoded.with_context(|| format!("{}: no masks", files.name))?;
    let truth = truth_of(&encoded.reader, &files.dir)?;
    let mut by = |kind| {
        let settings = JudgeSettings { kind: Some(kind), ..JudgeSettings::default() };
        judge(&encoded.reader, &truth, text, &settings)
    };
    let (of_gaussians, of_objects) = (by(EvalKind::Gaussians)?, by(EvalKind::Objects)?);
    let any = of_objects.instances.map(|instances| instances.any);
    let ap = of_gaussians.mean_average_precision;
    tracing::info!("{} {method}: AP {ap:.4?}, found {any:?}, {:.0} s", files.name, encoded.secs);
    Ok(Figures {
        n_views: encoded.summary.n_views,
        ap,
        miou: of_gaussians.multi_class.first().and_then(|all| all.miou),
        found: any.map(|any| any.n_at_50 as f64),
        n_things: any.map(|any| any.n as f64),
    })
}

impl fmt::Display for SplatOnlyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pairs = ["AP, photos", "drawings", "mIoU, photos", "drawings", "found, photos", "drawings", "of"];
        let mut table = Table::new(["scene", "views"].into_iter().chain(pairs));
        for row in self.scenes.iter().chain([&self.mean]) {
            let count = |n: Option<f64>| n.map_or("-".into(), |n| format!("{n:.0}"));
            let mut cells = vec![row.scene.clone(), count(Some(row.n_views))];
            cells.extend([row.ap_photos, row.ap_drawn, row.miou_photos, row.miou_drawn].map(figure));
            cells.extend([row.found_photos, row.found_drawn, row.n_things].map(count));
            table.row(cells);
        }
        write!(f, "{table}")
    }
}
