//! Measures a grid: points with the same contributions share a store.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;
use slag_encoder::progress::Progress;

use super::error::TradeoffError;
use super::figures::Figures;
use super::grid::{Grid, LabelledScene, Point};
use super::paper::PAPER;
use super::prediction::predictions;
use super::programs::Programs;
use super::report::TradeoffReport;
use crate::bench::machine::Machine;
use crate::bench::programs::remove;

/// What to measure.
#[derive(Clone, Debug)]
pub struct TradeoffSettings {
    /// Labelled scenes.
    pub scenes: Vec<LabelledScene>,
    /// Points to measure on each.
    pub grid: Grid,
    /// Folder for figures, plots, and stores while they are needed.
    pub out: PathBuf,
}

/// Measures the points that have no file yet and summarises all.
///
/// # Errors
/// [`TradeoffError`].
pub fn run(
    settings: &TradeoffSettings,
    programs: &Programs,
    progress: &dyn Progress,
) -> Result<TradeoffReport, TradeoffError> {
    let points_dir = settings.out.join("points");
    fs_err::create_dir_all(&points_dir)?;
    let mut measured = Vec::new();
    let mut left_out = Vec::new();
    progress.begin("tradeoff", "point", (settings.scenes.len() * settings.grid.points.len()) as u64, 0);
    for (number, scene) in settings.scenes.iter().enumerate() {
        if settings.scenes[..number].iter().any(|other| other.name == scene.name) {
            return Err(TradeoffError::SameName { name: scene.name.clone() });
        }
        let mut groups: Vec<Vec<&Point>> = Vec::new();
        for point in &settings.grid.points {
            match groups.iter_mut().find(|group| group[0].views == point.views) {
                Some(group) => group.push(point),
                None => groups.push(vec![point]),
            }
        }
        let mut of_point = BTreeMap::new();
        for group in groups {
            for (point, figures) in measure_group(scene, &group, programs, &settings.out, progress)? {
                of_point.insert((point.axis.as_str(), point.name.as_str()), figures);
            }
        }
        // In the order of the grid, whatever the order of the work.
        for point in &settings.grid.points {
            match of_point.remove(&(point.axis.as_str(), point.name.as_str())) {
                Some(Ok(figures)) => measured.push(figures),
                Some(Err(reason)) => {
                    left_out.push(format!("{} / {} on {}: {reason}", point.axis, point.name, scene.name));
                }
                None => {}
            }
        }
    }
    progress.end();
    let report = TradeoffReport {
        machine: Machine::here(),
        paper: PAPER,
        ordered: settings.grid.ordered.clone(),
        predictions: predictions(&measured),
        figures: measured,
        left_out,
    };
    report.write(&settings.out)?;
    Ok(report)
}

/// A point, and its figures or what the scene or machine lacks for it.
type Measured<'p> = (&'p Point, Result<Figures, &'static str>);

/// Measures points with the same contributions.
fn measure_group<'p>(
    scene: &LabelledScene,
    group: &[&'p Point],
    programs: &Programs,
    out: &Path,
    progress: &dyn Progress,
) -> Result<Vec<Measured<'p>>, TradeoffError> {
    let store = out.join("store");
    let mut done = Vec::new();
    // Seconds of the views, once known.
    let mut views_seconds = None;
    for point in group {
        let path = out.join("points").join(file_name(scene, point, programs));
        if path.is_file() {
            let figures: Figures = serde_json::from_slice(&fs_err::read(&path)?)
                .map_err(|source| TradeoffError::Measured { path, source })?;
            views_seconds.get_or_insert(figures.views_seconds);
            done.push((*point, Ok(figures)));
            progress.advance(1);
            continue;
        }
        let expand = |flags: &str| scene.expand(flags, &programs.equipment);
        let flags = [expand(&point.views)?, expand(&point.lift)?, expand(&point.eval)?];
        let (views, lift, eval) = match flags {
            [Ok(views), Ok(lift), Ok(eval)] => (views, lift, eval),
            [Err(reason), ..] | [_, Err(reason), _] | [.., Err(reason)] => {
                done.push((*point, Err(reason)));
                progress.advance(1);
                continue;
            }
        };
        let run = programs.of(scene, point);
        // The duration of views that an earlier run left is unknown.
        if views_seconds.is_none() {
            remove(&store)?;
        }
        let mut encoded = run.encode(&store, &views, &lift)?;
        if integer(&encoded, "n_views_resumed") != 0 && views_seconds.is_none()
            || integer(&encoded, "n_views_resumed") < integer(&encoded, "n_views") && views_seconds.is_some()
        {
            remove(&store)?;
            encoded = run.encode(&store, &views, &lift)?;
            views_seconds = None;
        }
        let own_views = run.figure(&encoded, "views_secs")?;
        let of_views = *views_seconds.get_or_insert(own_views);
        let judged = run.evaluate(&store, point.profile, &eval)?;
        let n_gaussians = run.figure(&encoded, "n_gaussians")?.max(1.0);
        let best = |name: &str| judged[name].as_f64();
        let all = &judged["multi_class"][0];
        let figures = Figures {
            scene: scene.name.clone(),
            point: (*point).clone(),
            made_by: programs.made_by.clone(),
            n_views: integer(&encoded, "n_views"),
            n_photos: integer(&encoded, "n_views_with_photo"),
            n_gaussians: n_gaussians as u64,
            n_masks: integer(&encoded, "n_masks"),
            coverage: encoded["coverage"]["coverage"].as_f64(),
            miou: run.figure(all, "miou")?,
            macc: run.figure(all, "macc")?,
            map: best("mean_average_precision"),
            auc: best("mean_area_under_roc"),
            localised: best("mean_localised"),
            iou_on_views: best("mean_iou_on_views"),
            n_unknown_words: judged["unknown_words"].as_object().map_or(0, |words| words.len() as u64),
            seconds: run.figure(&encoded, "wall_secs")? - own_views + of_views,
            views_seconds: of_views,
            coverage_seconds: run.figure(&encoded, "coverage_secs")?,
            bytes_per_gaussian: run.figure(&encoded["shard_bytes"], point.profile.name())? / n_gaussians,
            query_ms: run.query_ms(&store, out, point.profile)?,
        };
        // Renamed into place last: a point is measured completely or not at all.
        let text = serde_json::to_vec_pretty(&figures).map_err(std::io::Error::from)?;
        slag_common::durable::write(&path, &text)?;
        done.push((*point, Ok(figures)));
        progress.advance(1);
    }
    remove(&store)?;
    Ok(done)
}

/// Returns the name of a point's file; it depends on scene, point and programs.
fn file_name(scene: &LabelledScene, point: &Point, programs: &Programs) -> String {
    let dir = scene.dir.canonicalize().unwrap_or_else(|_| scene.dir.clone());
    // The first word is the version of the figures: files of another one are not read.
    let key = format!("2 {dir:?} {point:?} {}", programs.made_by);
    format!("{}-{}.json", scene.name, &blake3::hash(key.as_bytes()).to_hex()[..16])
}

fn integer(value: &Value, name: &str) -> u64 {
    value[name].as_u64().unwrap_or(0)
}
