//! Rules of a public comparison, enforced on reports of `eval lerf`: the threshold of a scene is the best one of the
//! *other* scenes, every labelled thing is reported, and no frame is left out.
//!
//! A threshold tuned on the judged scene's own words, words dropped from a mean, and frames matched with another camera are
//! the faults that audits find in published figures. `eval lerf` matches frames by name.

mod page;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use page::{Means, ScannetMeans, Scene, page};

/// Intersection over union from which a thing counts as found, as in OpenGaussian.
const FOUND_IOU: f64 = 0.25;

/// Error of a comparison.
#[derive(Debug, thiserror::Error)]
pub enum ProtocolError {
    /// A file could not be read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A report or label is malformed.
    #[error("{}: {cause}; give the output of `eval lerf --json`, or the labels of LERF-OVS", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The parser's error.
        cause: serde_json::Error,
    },
    /// Too few scenes to choose a threshold without the judged one.
    #[error("{n} scenes in {}; a threshold is frozen on the other scenes, so give two or more", dir.display())]
    FewScenes {
        /// The folder.
        dir: PathBuf,
        /// Scenes found.
        n: usize,
    },
    /// A report lacks labelled things, or has others.
    #[error(
        "{scene} at threshold {threshold}: {n_missing} labelled things are not reported (first: {first}) and \
         {n_other} are not labelled; evaluate every word and every frame, without --words"
    )]
    Things {
        /// The scene.
        scene: String,
        /// The report's threshold.
        threshold: f32,
        /// Labelled things that are not reported.
        n_missing: usize,
        /// The first of them.
        first: String,
        /// Reported things that are not labelled.
        n_other: usize,
    },
    /// Labelled frames have no pose.
    #[error(
        "{scene}: {n} labelled frames have no pose of their name, the first is {first}; give the poses of the same scene"
    )]
    Frames {
        /// The scene.
        scene: String,
        /// Frames without a pose.
        n: usize,
        /// The first of them.
        first: String,
    },
    /// Scenes were evaluated at different thresholds.
    #[error(
        "{scene} was evaluated at thresholds {found:?}, another scene at {expected:?}; evaluate all at the same"
    )]
    Thresholds {
        /// The scene.
        scene: String,
        /// Its thresholds.
        found: Vec<f32>,
        /// Those of the first scene.
        expected: Vec<f32>,
    },
}

/// A thing on a frame, as `eval lerf` reports it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ThingFigures {
    /// The frame.
    pub frame: String,
    /// The thing.
    pub category: String,
    /// Intersection over union of the rendered selection and its mask.
    pub iou: f64,
}

/// A report of `eval lerf`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct LerfFigures {
    /// Lowest score of a selected Gaussian.
    pub threshold: f32,
    /// Each thing on each frame.
    pub things: Vec<ThingFigures>,
    /// Labelled frames without a pose.
    pub frames_without_view: Vec<String>,
}

impl LerfFigures {
    fn miou(&self) -> f64 {
        self.things.iter().map(|thing| thing.iou).sum::<f64>() / self.things.len().max(1) as f64
    }

    fn accuracy(&self) -> f64 {
        let found = self.things.iter().filter(|thing| thing.iou > FOUND_IOU).count();
        found as f64 / self.things.len().max(1) as f64
    }
}

/// The reports of a scene, one per threshold, in ascending order.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// The scene.
    pub scene: String,
    /// Its reports.
    pub reports: Vec<LerfFigures>,
}

/// Labelled things of a scene: frame and category.
pub type Labelled = BTreeSet<(String, String)>;

/// Figures of a scene at a threshold that its own labels did not choose.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Judged {
    /// The scene.
    pub scene: String,
    /// The threshold: that with the highest mean mIoU of the other scenes; the lowest of several.
    pub threshold: f32,
    /// The scenes that chose it.
    pub frozen_on: Vec<String>,
    /// Things on frames, all of them labelled ones.
    pub n_things: usize,
    /// Mean intersection over union of the things.
    pub miou: f64,
    /// Share of the things with an intersection over union above 0.25.
    pub accuracy: f64,
}

fn parse<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ProtocolError> {
    serde_json::from_slice(&fs_err::read(path)?)
        .map_err(|cause| ProtocolError::Format { path: path.to_owned(), cause })
}

fn children(dir: &Path) -> Result<Vec<PathBuf>, ProtocolError> {
    let entries = fs_err::read_dir(dir)?.map(|entry| Ok(entry?.path()));
    let mut paths = entries.collect::<Result<Vec<_>, std::io::Error>>()?;
    paths.sort();
    Ok(paths)
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Reads `dir/SCENE/*.json`, reports of `eval lerf --json` at several thresholds.
///
/// # Errors
/// [`ProtocolError`].
pub fn read_sweeps(dir: &Path) -> Result<Vec<Sweep>, ProtocolError> {
    let mut sweeps = Vec::new();
    for scene in children(dir)?.into_iter().filter(|path| path.is_dir()) {
        let files =
            children(&scene)?.into_iter().filter(|path| path.extension().is_some_and(|e| e == "json"));
        let mut reports = files.map(|path| parse::<LerfFigures>(&path)).collect::<Result<Vec<_>, _>>()?;
        reports.sort_by(|a, b| a.threshold.total_cmp(&b.threshold));
        sweeps.push(Sweep { scene: name_of(&scene), reports });
    }
    if sweeps.len() < 2 {
        return Err(ProtocolError::FewScenes { dir: dir.to_owned(), n: sweeps.len() });
    }
    Ok(sweeps)
}

/// Reads the labelled things of a scene: `dir/frame_*.json`, as LERF-OVS has them.
///
/// # Errors
/// [`ProtocolError`].
pub fn read_labelled(dir: &Path) -> Result<Labelled, ProtocolError> {
    #[derive(Deserialize)]
    struct Label {
        info: Info,
        objects: Vec<Object>,
    }
    #[derive(Deserialize)]
    struct Info {
        name: String,
    }
    #[derive(Deserialize)]
    struct Object {
        category: String,
    }
    let mut labelled = Labelled::new();
    for path in children(dir)? {
        let name = name_of(&path);
        if name.starts_with("frame_") && name.ends_with(".json") {
            let label: Label = parse(&path)?;
            let frame = Path::new(&label.info.name).file_stem().unwrap_or_default();
            let frame = frame.to_string_lossy().into_owned();
            labelled.extend(label.objects.into_iter().map(|object| (frame.clone(), object.category)));
        }
    }
    Ok(labelled)
}

/// Checks that every report of a scene has all labelled things and no others, and a pose for every frame.
///
/// # Errors
/// [`ProtocolError::Things`], [`ProtocolError::Frames`].
pub fn check(sweep: &Sweep, labelled: &Labelled) -> Result<(), ProtocolError> {
    for report in &sweep.reports {
        let scene = sweep.scene.clone();
        if let Some(first) = report.frames_without_view.first().cloned() {
            return Err(ProtocolError::Frames { scene, n: report.frames_without_view.len(), first });
        }
        let key = |thing: &ThingFigures| (thing.frame.clone(), thing.category.clone());
        let reported: Labelled = report.things.iter().map(key).collect();
        let missing: Vec<_> = labelled.difference(&reported).collect();
        let n_other = reported.difference(labelled).count() + (report.things.len() - reported.len());
        if !missing.is_empty() || n_other > 0 {
            let first = missing.first().map_or("none".into(), |(frame, word)| format!("{word:?} on {frame}"));
            let (threshold, n_missing) = (report.threshold, missing.len());
            return Err(ProtocolError::Things { scene, threshold, n_missing, first, n_other });
        }
    }
    Ok(())
}

/// Judges each scene at the threshold that is best on the mean of the others.
///
/// # Errors
/// [`ProtocolError::Thresholds`] if scenes were evaluated at different thresholds.
pub fn leave_one_out(sweeps: &[Sweep]) -> Result<Vec<Judged>, ProtocolError> {
    let thresholds = |sweep: &Sweep| sweep.reports.iter().map(|report| report.threshold).collect::<Vec<_>>();
    let expected = sweeps.first().map(thresholds).unwrap_or_default();
    for sweep in sweeps {
        let (scene, found) = (sweep.scene.clone(), thresholds(sweep));
        if found != expected || found.is_empty() {
            return Err(ProtocolError::Thresholds { scene, found, expected });
        }
    }
    let judged = sweeps.iter().map(|sweep| {
        let others: Vec<&Sweep> = sweeps.iter().filter(|other| other.scene != sweep.scene).collect();
        let sum = |at: usize| others.iter().map(|other| other.reports[at].miou()).sum::<f64>();
        let better = |best: usize, at: usize| if sum(at) > sum(best) { at } else { best };
        let at = (0..expected.len()).reduce(better).unwrap_or(0);
        judge(sweep, at, others.iter().map(|other| other.scene.clone()).collect())
    });
    Ok(judged.collect())
}

/// Judges each scene at the given threshold, for example the paper's; scenes without it are left out.
pub fn at_fixed(sweeps: &[Sweep], threshold: f32) -> BTreeMap<String, Judged> {
    let near = |report: &LerfFigures| (report.threshold - threshold).abs() < 1e-6;
    let found = |sweep: &Sweep| Some(judge(sweep, sweep.reports.iter().position(near)?, Vec::new()));
    sweeps.iter().filter_map(found).map(|judged| (judged.scene.clone(), judged)).collect()
}

fn judge(sweep: &Sweep, at: usize, frozen_on: Vec<String>) -> Judged {
    let report = &sweep.reports[at];
    Judged {
        scene: sweep.scene.clone(),
        threshold: report.threshold,
        frozen_on,
        n_things: report.things.len(),
        miou: report.miou(),
        accuracy: report.accuracy(),
    }
}
