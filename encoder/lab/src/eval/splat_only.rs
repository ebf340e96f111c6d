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

/// Figures of a scene, or means over all.
#[derive(Clone, Debug, Serialize)]
struct Row {
    scene: String,
    photos: Figures,
    drawn: Figures,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Figures {
    n_views: Option<f64>,
    ap: Option<f64>,
    miou: Option<f64>,
    /// Things found at IoU 0.5 by any object.
    found: Option<f64>,
    n_things: Option<f64>,
}

impl Figures {
    fn mean(all: &[Self]) -> Self {
        let of = |figure: fn(&Self) -> Option<f64>| mean(all.iter().map(figure));
        Self {
            n_views: of(|f| f.n_views),
            ap: of(|f| f.ap),
            miou: of(|f| f.miou),
            found: of(|f| f.found),
            n_things: of(|f| f.n_things),
        }
    }
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct SplatOnlyReport {
    encoder: String,
    scenes: Vec<Row>,
    mean: Row,
}

pub(crate) fn run(args: &ScenesArgs, progress: &dyn Progress) -> Result<SplatOnlyReport> {
    let runner = Runner::open(args)?;
    let mut text = runner.text_encoder()?;
    let files = SceneFiles::find_all(&args.scene)?;
    progress.begin("splat only", "encode", 2 * files.len() as u64, 0);
    let mut scenes = Vec::new();
    for files in &files {
        let drawn_at = args.out.join(&files.name).join("drawn").join(POSES_FILE);
        let (n_views, drawn) = figures(&runner, files, "drawings", &mut *text, |settings| {
            settings.inputs.images = None;
            settings.inputs.views = drawn_at;
            settings.inputs.planned = Some(ViewpointSettings { n_views: DEFAULT_N_VIEWS, up: None });
        })?;
        progress.advance(1);
        let (_, photos) = figures(&runner, files, "photos", &mut *text, |settings| {
            settings.run.views_limit = ViewsLimit::Count(n_views);
            settings.run.view_order = ViewOrder::Coverage;
        })?;
        progress.advance(1);
        scenes.push(Row { scene: files.name.clone(), photos, drawn });
    }
    progress.end();
    let of = |side: fn(&Row) -> Figures| Figures::mean(&scenes.iter().map(side).collect::<Vec<_>>());
    let mean = Row { scene: "mean".into(), photos: of(|row| row.photos), drawn: of(|row| row.drawn) };
    Ok(SplatOnlyReport { encoder: runner.encoder_id(), scenes, mean })
}

/// Encodes a scene and judges it, by Gaussian; things are found by objects. Returns the number of views, too.
fn figures(
    runner: &Runner,
    files: &SceneFiles,
    method: &str,
    text: &mut dyn TextEncoder,
    change: impl FnOnce(&mut EncodeSettings),
) -> Result<(usize, Figures)> {
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
    let any = of_objects.instances;
    let n_views = encoded.summary.n_views;
    let figures = Figures {
        n_views: Some(n_views as f64),
        ap: of_gaussians.mean_average_precision,
        miou: of_gaussians.miou,
        found: any.map(|any| any.n_at_50 as f64),
        n_things: any.map(|any| any.n as f64),
    };
    tracing::info!("{} {method}: {figures:?}, {:.0} s", files.name, encoded.secs);
    Ok((n_views, figures))
}

impl fmt::Display for SplatOnlyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let pairs = ["AP, photos", "drawings", "mIoU, photos", "drawings", "found, photos", "drawings", "of"];
        let mut table = Table::new(["scene", "views"].into_iter().chain(pairs));
        for Row { scene, photos, drawn } in self.scenes.iter().chain([&self.mean]) {
            let count = |n: Option<f64>| n.map_or("-".into(), |n| format!("{n:.0}"));
            let mut cells = vec![scene.clone(), count(drawn.n_views)];
            cells.extend([photos.ap, drawn.ap, photos.miou, drawn.miou].map(figure));
            cells.extend([photos.found, drawn.found, drawn.n_things].map(count));
            table.row(cells);
        }
        write!(f, "{table}")
    }
}
