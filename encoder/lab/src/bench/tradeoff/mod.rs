//! `bench tradeoff`: what each choice costs and gives, on labelled scenes.
//!
//! Each point of a [`grid`] is encoded, judged and asked by the programs as a user runs them, each in a process of
//! its own, so that threads and memory are as told. A point leaves one JSON file; points that have one are not
//! measured again. Points with the same sums share a store: the first one's seconds are measured, the others' are
//! the first one's seconds of views and their own of everything else.

pub mod grid;
mod programs;
mod report;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use grid::{Grid, LabelledScene, Point};
pub use programs::Programs;
pub use report::TradeoffReport;

use super::Machine;
use slag_encoder::progress::Progress;

/// What was published about the paper's choice of speed or accuracy; its accuracies are not in this project's files.
const PAPER_SECONDS: [f64; 4] = [129.0, 309.0, 1328.0, 3026.0];

/// Why the grid was not measured to its end. What was measured stays.
#[derive(Debug, thiserror::Error)]
pub enum TradeoffError {
    /// A file could not be read or written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The grid is not as expected.
    #[error("{}: {what}; expected {{\"points\": [..]}}, each with axis and name, and views, lift, eval, profile if need be", path.display())]
    Grid {
        /// The file.
        path: PathBuf,
        /// What was found.
        what: String,
    },
    /// Flags with a placeholder that is none.
    #[error("{flags:?}: {word} is not known; there is {{masks}}")]
    Flags {
        /// The flags.
        flags: String,
        /// The word.
        word: String,
    },
    /// A folder is no labelled scene.
    #[error("{}: {what}; give a folder as `generate scene` writes it", dir.display())]
    Scene {
        /// The folder.
        dir: PathBuf,
        /// What is missing.
        what: String,
    },
    /// Two scenes would share files.
    #[error("two scenes are called {name}; rename one of their folders")]
    SameName {
        /// The name.
        name: String,
    },
    /// A program failed.
    #[error("{axis} / {name} on {scene}: {command}: {message}")]
    Program {
        /// The scene.
        scene: String,
        /// The point's axis.
        axis: String,
        /// The point's name.
        name: String,
        /// What was run.
        command: String,
        /// What it said.
        message: String,
    },
    /// A point's file is not as expected.
    #[error("{}: {source}; delete it, it is measured again", path.display())]
    Measured {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        source: serde_json::Error,
    },
}

/// What a point costs and gives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// The scene.
    pub scene: String,
    /// What was tried.
    #[serde(flatten)]
    pub point: Point,
    /// Models, device and version: figures of others are not comparable.
    pub made_by: String,
    /// Views used.
    pub n_views: u64,
    /// Masks used.
    pub n_masks: u64,
    /// What the views show of what all show, where they were taken by it.
    pub coverage: Option<f64>,
    /// Multi-class intersection over union, mean over the categories.
    pub miou: f64,
    /// Multi-class accuracy, mean over the categories.
    pub macc: f64,
    /// Mean average precision.
    pub map: Option<f64>,
    /// Mean area under the ROC curve.
    pub auc: Option<f64>,
    /// Views' best pixels that lie on the thing.
    pub localised: Option<f64>,
    /// Intersection over union on test views.
    pub iou_on_views: Option<f64>,
    /// Words that no mean counts, because the encoder does not know them.
    pub n_unknown_words: u64,
    /// Seconds of the encode.
    pub seconds: f64,
    /// Of these, of the views.
    pub views_seconds: f64,
    /// Of these, of choosing them.
    pub coverage_seconds: f64,
    /// Bytes a Gaussian of the profile's shards.
    pub bytes_per_gaussian: f64,
    /// Milliseconds of a query for the best thousand, median; absent without the robot's program.
    pub query_ms: Option<f64>,
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct TradeoffSettings {
    /// Labelled scenes.
    pub scenes: Vec<LabelledScene>,
    /// What is tried on each.
    pub grid: Grid,
    /// Folder for figures, plots, and stores while they are needed.
    pub out: PathBuf,
}

/// Measures what is not measured yet and sums everything up.
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
                Some(Some(figures)) => measured.push(figures),
                _ => left_out
                    .push(format!("{} / {} on {}: it has no gt/masks", point.axis, point.name, scene.name)),
            }
        }
    }
    progress.end();
    let report = TradeoffReport {
        machine: Machine::here(),
        paper_seconds: PAPER_SECONDS,
        figures: measured,
        left_out,
    };
    report.write(&settings.out)?;
    Ok(report)
}

/// Measures points with the same sums; `None` where the scene lacks what a point needs.
fn measure_group<'p>(
    scene: &LabelledScene,
    group: &[&'p Point],
    programs: &Programs,
    out: &Path,
    progress: &dyn Progress,
) -> Result<Vec<(&'p Point, Option<Figures>)>, TradeoffError> {
    let store = out.join("store");
    let mut done = Vec::new();
    // Seconds that the sums took, once they are known.
    let mut views_seconds = None;
    for point in group {
        let path = out.join("points").join(file_name(scene, point, programs));
        if path.is_file() {
            let figures: Figures = serde_json::from_slice(&fs_err::read(&path)?)
                .map_err(|source| TradeoffError::Measured { path, source })?;
            views_seconds.get_or_insert(figures.views_seconds);
            done.push((*point, Some(figures)));
            progress.advance(1);
            continue;
        }
        let expand = |flags: &str| scene.expand(flags);
        let (Some(views), Some(lift), Some(eval)) =
            (expand(&point.views)?, expand(&point.lift)?, expand(&point.eval)?)
        else {
            done.push((*point, None));
            progress.advance(1);
            continue;
        };
        let run = programs.of(scene, point);
        // Sums that a run before this one left are of unknown seconds.
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
        // The file last and at once: a point is measured as a whole or not.
        let text = serde_json::to_vec_pretty(&figures).map_err(std::io::Error::from)?;
        slag_common::durable::write(&path, &text)?;
        done.push((*point, Some(figures)));
        progress.advance(1);
    }
    remove(&store)?;
    Ok(done)
}

/// Another scene, point or program makes another file.
fn file_name(scene: &LabelledScene, point: &Point, programs: &Programs) -> String {
    let dir = scene.dir.canonicalize().unwrap_or_else(|_| scene.dir.clone());
    let key = format!("{dir:?} {point:?} {}", programs.made_by);
    format!("{}-{}.json", scene.name, &blake3::hash(key.as_bytes()).to_hex()[..16])
}

fn remove(store: &Path) -> std::io::Result<()> {
    if store.exists() { fs_err::remove_dir_all(store) } else { Ok(()) }
}

fn integer(value: &Value, name: &str) -> u64 {
    value[name].as_u64().unwrap_or(0)
}

#[cfg(test)]
mod tests;
