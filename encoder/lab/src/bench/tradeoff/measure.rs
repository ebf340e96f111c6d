//! Measures a grid: points with the same contributions share a store.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use serde_json::Value;
use slag_encoder::progress::Progress;

use super::grid::{Grid, Point, expand};
use super::report::{Figures, TradeoffReport};
use crate::harness::Machine;
use crate::programs::{json_of, remove};
use crate::scenes::SceneFiles;

#[derive(Clone, Debug)]
pub(super) struct Programs {
    pub(super) encoder: PathBuf,
    pub(super) lab: PathBuf,
    pub(super) models: Vec<String>,
    pub(super) segmenter: Option<PathBuf>,
    /// Version, models and device in words.
    pub(super) made_by: String,
}

/// Measures the points that have no file yet and summarises all. Points measured before an error are kept.
pub(super) fn measure(
    scenes: &[SceneFiles],
    grid: &Grid,
    programs: &Programs,
    out: &Path,
    progress: &dyn Progress,
) -> Result<TradeoffReport> {
    fs_err::create_dir_all(out.join("points"))?;
    let (mut measured, mut left_out) = (Vec::new(), Vec::new());
    progress.begin("tradeoff", "point", (scenes.len() * grid.points.len()) as u64, 0);
    for scene in scenes {
        let mut groups: BTreeMap<&str, Vec<&Point>> = BTreeMap::new();
        grid.points.iter().for_each(|point| groups.entry(&point.views).or_default().push(point));
        let mut of_point = BTreeMap::new();
        for group in groups.into_values() {
            for (point, figures) in measure_group(scene, &group, programs, out, progress)? {
                of_point.insert((point.axis.as_str(), point.name.as_str()), figures);
            }
        }
        // In the grid's order, not that of the work.
        for point in &grid.points {
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
    let report = TradeoffReport { machine: Machine::here(), figures: measured, left_out };
    report.write(out)?;
    Ok(report)
}

/// A point with its figures, or with what the scene or machine lacks for it.
type Measured<'p> = (&'p Point, Result<Figures, &'static str>);

fn measure_group<'p>(
    scene: &SceneFiles,
    group: &[&'p Point],
    programs: &Programs,
    out: &Path,
    progress: &dyn Progress,
) -> Result<Vec<Measured<'p>>> {
    let store = out.join("store");
    let mut done = Vec::new();
    let mut views_seconds = None;
    for point in group {
        let path = out.join("points").join(file_name(scene, point, programs));
        let figures = if path.is_file() {
            let malformed = || format!("{}: delete the file to measure the point again", path.display());
            let kept: Figures = serde_json::from_slice(&fs_err::read(&path)?).with_context(malformed)?;
            views_seconds.get_or_insert(kept.views_seconds);
            Ok(kept)
        } else {
            let run = Run { programs, scene, point, store: &store };
            let of_point = || format!("{} / {} on {}", point.axis, point.name, scene.name);
            let figures = run.measure(&mut views_seconds).with_context(of_point)?;
            if let Ok(figures) = &figures {
                // Renamed into place: a point is measured completely or not at all.
                slag_common::durable::write(&path, &serde_json::to_vec_pretty(figures)?)?;
            }
            figures
        };
        done.push((*point, figures));
        progress.advance(1);
    }
    remove(&store)?;
    Ok(done)
}

/// Returns the name of a point's file; it depends on scene, point and programs.
fn file_name(scene: &SceneFiles, point: &Point, programs: &Programs) -> String {
    let dir = scene.dir.canonicalize().unwrap_or_else(|_| scene.dir.clone());
    // The first word is the version of the figures: files of another one are not read.
    let key = format!("6 {dir:?} {point:?} {}", programs.made_by);
    format!("{}-{}.json", scene.name, &blake3::hash(key.as_bytes()).to_hex()[..16])
}

struct Run<'a> {
    programs: &'a Programs,
    scene: &'a SceneFiles,
    point: &'a Point,
    store: &'a Path,
}

impl Run<'_> {
    fn measure(&self, views_seconds: &mut Option<f64>) -> Result<Result<Figures, &'static str>> {
        let (point, programs) = (self.point, self.programs);
        let expand = |flags: &str| expand(flags, self.scene, programs.segmenter.as_ref());
        let (views, lift) = match [expand(&point.views)?, expand(&point.lift)?] {
            [Ok(views), Ok(lift)] => (views, lift),
            [Err(reason), _] | [_, Err(reason)] => return Ok(Err(reason)),
        };
        // The duration of views that an earlier run left is unknown.
        if views_seconds.is_none() {
            remove(self.store)?;
        }
        let mut encoded = self.encode(&views, &lift)?;
        let integer = |value: &Value, name: &str| value[name].as_u64().unwrap_or(0);
        if views_seconds.is_some() && integer(&encoded, "n_views_resumed") < integer(&encoded, "n_views") {
            remove(self.store)?;
            encoded = self.encode(&views, &lift)?;
            *views_seconds = None;
        }
        let own_views = figure(&encoded, "views_secs")?;
        let of_views = *views_seconds.get_or_insert(own_views);
        let judged = self.evaluate()?;
        let n_gaussians = figure(&encoded, "n_gaussians")?.max(1.0);
        Ok(Ok(Figures {
            scene: self.scene.name.clone(),
            point: point.clone(),
            made_by: programs.made_by.clone(),
            n_photos: integer(&encoded, "n_views_with_photo"),
            n_gaussians: n_gaussians as u64,
            miou: figure(&judged, "miou")?,
            map: judged["mean_average_precision"].as_f64(),
            seconds: figure(&encoded, "wall_secs")? - own_views + of_views,
            views_seconds: of_views,
            coverage_seconds: figure(&encoded, "coverage_secs")?,
            bytes_per_gaussian: figure(&encoded["shard_bytes"], point.profile.name())? / n_gaussians,
        }))
    }

    /// Encodes the scene and returns the summary; the views' contributions are kept.
    fn encode(&self, views: &[String], lift: &[String]) -> Result<Value> {
        let mut command = Command::new(&self.programs.encoder);
        command.args(["--json", "encode", "--metric", "--keep-views", "--scene"]).arg(&self.scene.splat);
        command.arg("--views").arg(&self.scene.poses).arg("--store").arg(self.store);
        if let Some(images) = &self.scene.images {
            command.arg("--images").arg(images);
        }
        json_of(command.args(&self.programs.models).args(views).args(lift))
    }

    fn evaluate(&self) -> Result<Value> {
        let mut command = Command::new(&self.programs.lab);
        command.args(["--json", "eval", "labelled", "--truth"]).arg(&self.scene.dir);
        command.arg("--store").arg(self.store);
        command.args(["--profile", self.point.profile.name()]);
        json_of(command.args(&self.programs.models))
    }
}

fn figure(printed: &Value, name: &str) -> Result<f64> {
    let missing = || format!("no {name} in the JSON: the flags leave nothing to measure");
    printed[name].as_f64().with_context(missing)
}
