//! Table and plots of a measured grid, and the front that `slag-encoder encode --front` reads.

use std::fmt;
use std::path::Path;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use slag_encoder::encode::front::{Front, FrontSetting};

use super::grid::Point;
use crate::bench::plot::{self, PlotPoint};
use crate::harness::Machine;
use crate::table::{Table, figure};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Figures {
    pub(super) scene: String,
    #[serde(flatten)]
    pub(super) point: Point,
    /// Models, device and version; figures of others are not comparable.
    pub(super) made_by: String,
    pub(super) n_views: u64,
    /// Views of the scene with a photo, before any were chosen.
    pub(super) n_photos: u64,
    pub(super) n_gaussians: u64,
    pub(super) n_masks: u64,
    pub(super) miou: f64,
    pub(super) macc: f64,
    pub(super) map: Option<f64>,
    pub(super) auc: Option<f64>,
    /// Words that the encoder does not know; no mean counts them.
    pub(super) n_unknown_words: u64,
    /// Seconds of the encode; those for the views; those for choosing the views.
    pub(super) seconds: f64,
    pub(super) views_seconds: f64,
    pub(super) coverage_seconds: f64,
    pub(super) bytes_per_gaussian: f64,
}

/// Figures of a measured grid, in the order of scenes and grid.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct TradeoffReport {
    pub(super) machine: Machine,
    pub(super) figures: Vec<Figures>,
    pub(crate) left_out: Vec<String>,
}

/// A cost or an accuracy, for one axis of a plot.
struct Measure<T> {
    /// Part of the plots' file names.
    file: &'static str,
    axis: &'static str,
    of: fn(&Figures) -> T,
}

const COSTS: [Measure<f64>; 2] = [
    Measure { file: "seconds", axis: "seconds of the encode", of: |f| f.seconds },
    Measure { file: "bytes", axis: "bytes per Gaussian", of: |f| f.bytes_per_gaussian },
];

/// Which word wins at a Gaussian, and which Gaussians come first for a word, as the paper and as a search judge.
const ACCURACIES: [Measure<Option<f64>>; 2] = [
    Measure { file: "", axis: "multi-class mIoU", of: |f| Some(f.miou) },
    Measure { file: "-ap", axis: "mean average precision", of: |f| f.map },
];

/// A point's figures, averaged over scenes.
struct Mean<'a> {
    point: &'a Point,
    cost: f64,
    accuracy: f64,
}

/// Returns the mean of each point that all of these scenes have, in the order of the first scene.
fn means<'a>(
    figures: &'a [Figures],
    scenes: &[&str],
    cost: impl Fn(&Figures) -> f64,
    accuracy: impl Fn(&Figures) -> Option<f64>,
) -> Vec<Mean<'a>> {
    let n = scenes.len();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
    let of_point = |of_first: &'a Figures| {
        let point = &of_first.point;
        let of_point: Vec<&Figures> =
            figures.iter().filter(|f| f.point == *point && scenes.contains(&f.scene.as_str())).collect();
        let costs: Vec<f64> = of_point.iter().map(|f| cost(f)).collect();
        let accuracies: Vec<f64> = of_point.iter().filter_map(|f| accuracy(f)).collect();
        let is_whole = costs.len() == n && accuracies.len() == n;
        is_whole.then(|| Mean { point, cost: mean(&costs), accuracy: mean(&accuracies) })
    };
    figures.iter().filter(|f| Some(&f.scene.as_str()) == scenes.first()).filter_map(of_point).collect()
}

/// Returns which (cost, accuracy) points are Pareto-optimal: no other point is at least as cheap and as accurate,
/// and differs.
pub(super) fn pareto(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
    points.iter().map(|point| !points.iter().any(|other| beats(other, point))).collect()
}

impl TradeoffReport {
    /// Writes `tradeoff.json`, `tradeoff.md`, `front.json`, and the plots of the scenes' mean, one a cost and
    /// accuracy.
    pub(super) fn write(&self, out: &Path) -> Result<()> {
        fs_err::write(out.join("tradeoff.json"), serde_json::to_vec_pretty(self)?)?;
        fs_err::write(out.join("tradeoff.md"), self.to_string())?;
        fs_err::write(out.join("front.json"), serde_json::to_vec_pretty(&self.front())?)?;
        for (cost, accuracy) in COSTS.iter().flat_map(|cost| ACCURACIES.iter().map(move |a| (cost, a))) {
            if let Some(svg) = self.svg(cost, accuracy) {
                fs_err::write(out.join(format!("{}{}.svg", cost.file, accuracy.file)), svg)?;
            }
        }
        Ok(())
    }

    fn scenes(&self) -> Vec<&str> {
        let mut scenes: Vec<&str> = self.figures.iter().map(|f| f.scene.as_str()).collect();
        scenes.dedup();
        scenes
    }

    /// Returns the settings that no other beats in seconds or bytes, on the mean of the scenes; only those that a
    /// user can give on any scene: without placeholders, and flags of the machine.
    fn front(&self) -> Front {
        let scenes = self.scenes();
        let of_views = |f: &Figures| f.views_seconds + f.coverage_seconds;
        let of = |cost: &dyn Fn(&Figures) -> f64| means(&self.figures, &scenes, cost, |f| Some(f.miou));
        let seconds = of(&|f| f.seconds);
        let per_view = of(&|f| of_views(f) / f.n_photos.max(1) as f64);
        let rest = of(&|f| (f.seconds - of_views(f)).max(0.0) / (f.n_gaussians.max(1) as f64 / 1e6));
        let bytes = of(&|f| f.bytes_per_gaussian);
        let mut settings: Vec<(f64, FrontSetting)> = Vec::new();
        for (((seconds, view), rest), bytes) in seconds.iter().zip(per_view).zip(rest).zip(bytes) {
            let point = seconds.point;
            let flags = [point.views.as_str(), point.lift.as_str()].join(" ");
            let is_of_machine = ["{", "--threads", "--device", "--every"].iter().any(|f| flags.contains(f));
            if is_of_machine {
                continue;
            }
            let setting = FrontSetting {
                name: format!("{} / {}", point.axis, point.name),
                flags: flags.trim().to_owned(),
                profile: point.profile,
                seconds_per_view: view.cost,
                seconds_per_million_gaussians: rest.cost,
                bytes_per_gaussian: bytes.cost,
                miou: seconds.accuracy,
            };
            settings.push((seconds.cost, setting));
        }
        let of_seconds: Vec<(f64, f64)> = settings.iter().map(|(s, f)| (*s, f.miou)).collect();
        let of_bytes: Vec<(f64, f64)> =
            settings.iter().map(|(_, f)| (f.bytes_per_gaussian, f.miou)).collect();
        let on_front = pareto(&of_seconds).into_iter().zip(pareto(&of_bytes)).map(|(a, b)| a || b);
        let kept = settings.into_iter().zip(on_front).filter(|(_, is_on)| *is_on).map(|((_, f), _)| f);
        Front {
            machine: self.machine.to_string(),
            measured_with: self.figures.first().map_or(String::new(), |f| f.made_by.clone()),
            n_scenes: scenes.len(),
            settings: kept.collect(),
        }
    }

    /// Draws an accuracy against a cost, means over scenes; `None` without a point that all scenes have.
    fn svg(&self, cost: &Measure<f64>, accuracy: &Measure<Option<f64>>) -> Option<String> {
        let scenes = self.scenes();
        let means = means(&self.figures, &scenes, cost.of, accuracy.of);
        let all: Vec<(f64, f64)> = means.iter().map(|mean| (mean.cost, mean.accuracy)).collect();
        let point = |(mean, is_on_front): (&Mean<'_>, bool)| PlotPoint {
            name: format!("{} / {}", mean.point.axis, mean.point.name),
            cost: mean.cost,
            accuracy: mean.accuracy,
            is_on_front,
        };
        let points: Vec<PlotPoint> = means.iter().zip(pareto(&all)).map(point).collect();
        let Machine { cpu, n_threads, .. } = &self.machine;
        let title = format!("{}: {cpu}, {n_threads} threads", scenes.join(", "));
        (!points.is_empty()).then(|| plot::svg(&title, [cost.axis, accuracy.axis], &points))
    }
}

impl fmt::Display for TradeoffReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Pareto-optimal in mIoU and seconds (s), bytes (b) of its scene.\n")?;
        let columns = [
            "scene", "", "axis", "point", "seconds", "views", "masks", "mIoU", "mAcc", "AP", "AUC", "bytes/G",
        ];
        let mut table = Table::new(columns);
        for scene in self.scenes() {
            let of_scene: Vec<&Figures> = self.figures.iter().filter(|f| f.scene == scene).collect();
            let fronts = COSTS.each_ref().map(|cost| {
                pareto(&of_scene.iter().map(|f| ((cost.of)(f), f.miou)).collect::<Vec<(f64, f64)>>())
            });
            for (number, p) in of_scene.into_iter().enumerate() {
                let marks = ["s", "b"].into_iter().zip(&fronts).filter(|(_, front)| front[number]);
                table.row([
                    scene.to_owned(),
                    marks.map(|(mark, _)| mark).collect(),
                    p.point.axis.clone(),
                    p.point.name.clone(),
                    format!("{:.1}", p.seconds),
                    p.n_views.to_string(),
                    p.n_masks.to_string(),
                    figure(Some(p.miou)),
                    figure(Some(p.macc)),
                    figure(p.map),
                    figure(p.auc),
                    format!("{:.2}", p.bytes_per_gaussian),
                ]);
            }
        }
        write!(f, "{table}")?;
        self.left_out.iter().try_for_each(|point| writeln!(f, "- not run: {point}"))?;
        match self.figures.iter().map(|f| f.n_unknown_words).max() {
            Some(n @ 1..) => writeln!(f, "{n} words are unknown to the encoder and left out of the means"),
            _ => Ok(()),
        }
    }
}
