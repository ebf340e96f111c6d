//! Tables and plots of a measured grid, and the front that `slag-encoder encode --front` reads.

use std::fmt;
use std::path::Path;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use slag_encoder::encode::front::{Front, FrontSetting};
use slag_encoder::html::Page;

use super::grid::Point;
use crate::bench::plot::{Plot, Series, Style};
use crate::harness::Machine;
use crate::table::{Table, figure};

/// Cost and accuracy of a point.
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
    /// Milliseconds of a query for the best thousand, median; absent without slag-edge.
    pub(super) query_ms: Option<f64>,
}

/// Figures of a measured grid, in the order of scenes and grid.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct TradeoffReport {
    pub(super) machine: Machine,
    /// Axes whose points ascend.
    pub(super) ordered: Vec<String>,
    pub(super) figures: Vec<Figures>,
    /// Points left out because a scene lacks their data.
    pub(crate) left_out: Vec<String>,
}

/// A cost or an accuracy, for one axis of a plot.
struct Measure {
    /// Part of the plots' file names.
    file: &'static str,
    axis: &'static str,
    of: fn(&Figures) -> Option<f64>,
}

const COSTS: [Measure; 3] = [
    Measure { file: "seconds", axis: "seconds of the encode", of: |f| Some(f.seconds) },
    Measure { file: "bytes", axis: "bytes per Gaussian", of: |f| Some(f.bytes_per_gaussian) },
    Measure { file: "query", axis: "milliseconds per query", of: |f| f.query_ms },
];

/// Which word wins at a Gaussian, and which Gaussians come first for a word, as the paper and as a search judge.
const ACCURACIES: [Measure; 2] = [
    Measure { file: "", axis: "multi-class mIoU", of: |f| Some(f.miou) },
    Measure { file: "-ap", axis: "mean average precision", of: |f| f.map },
];

/// A point's figures, averaged over scenes.
struct Mean<'a> {
    point: &'a Point,
    cost: f64,
    accuracy: f64,
    /// Standard deviation of the accuracy over scenes; 0 for one scene.
    spread: f64,
}

/// Returns the mean of each point that all of these scenes have, in the order of the first scene.
fn means<'a>(
    figures: &'a [Figures],
    scenes: &[&str],
    cost: impl Fn(&Figures) -> Option<f64>,
    accuracy: impl Fn(&Figures) -> Option<f64>,
) -> Vec<Mean<'a>> {
    let n = scenes.len();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
    let of_point = |of_first: &'a Figures| {
        let point = &of_first.point;
        let of_point: Vec<&Figures> =
            figures.iter().filter(|f| f.point == *point && scenes.contains(&f.scene.as_str())).collect();
        let costs: Vec<f64> = of_point.iter().filter_map(|f| cost(f)).collect();
        let accuracies: Vec<f64> = of_point.iter().filter_map(|f| accuracy(f)).collect();
        let is_whole = costs.len() == n && accuracies.len() == n;
        let accuracy = mean(&accuracies);
        let squares = accuracies.iter().map(|a| (a - accuracy).powi(2)).sum::<f64>();
        // Of a sample: divided by one less than their number.
        let spread = (squares / (n.max(2) - 1) as f64).sqrt();
        is_whole.then(|| Mean { point, cost: mean(&costs), accuracy, spread })
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
    /// Writes `tradeoff.json`, `tradeoff.md`, `front.json`, the plots (one per scene, cost and accuracy, and of
    /// several scenes one of their mean), and `tradeoff.html`, which has the plots and tables in one page.
    pub(super) fn write(&self, out: &Path) -> Result<()> {
        fs_err::write(out.join("tradeoff.json"), serde_json::to_vec_pretty(self)?)?;
        fs_err::write(out.join("tradeoff.md"), self.to_string())?;
        fs_err::write(out.join("front.json"), serde_json::to_vec_pretty(&self.front())?)?;
        let mut page = Page::new("Accuracy against time, bytes and latency");
        let scenes = self.scenes();
        let mut pictures: Vec<(&str, &[&str])> =
            scenes.iter().map(|s| (*s, std::slice::from_ref(s))).collect();
        if scenes.len() > 1 {
            pictures.push(("mean", &scenes));
        }
        for (name, scenes) in pictures {
            for (cost, accuracy) in COSTS.iter().flat_map(|cost| ACCURACIES.iter().map(move |a| (cost, a))) {
                if let Some(svg) = self.svg(name, scenes, cost, accuracy) {
                    page.drawing(&svg, &format!("{name}: {} by {}", accuracy.axis, cost.axis));
                    fs_err::write(out.join(format!("{name}-{}{}.svg", cost.file, accuracy.file)), svg)?;
                }
            }
        }
        page.plain(&self.to_string());
        page.value(&serde_json::to_value(self)?);
        Ok(fs_err::write(out.join("tradeoff.html"), page.finish())?)
    }

    fn scenes(&self) -> Vec<&str> {
        let mut scenes: Vec<&str> = self.figures.iter().map(|f| f.scene.as_str()).collect();
        scenes.dedup();
        scenes
    }

    /// Returns the settings that no other beats in seconds or bytes, on the mean of the scenes; only those that a
    /// user can give on any scene: without placeholders, flags of the evaluation, or a view of the machine.
    fn front(&self) -> Front {
        let scenes = self.scenes();
        let of_views = |f: &Figures| f.views_seconds + f.coverage_seconds;
        let of = |cost: &dyn Fn(&Figures) -> f64| {
            means(&self.figures, &scenes, |f| Some(cost(f)), |f| Some(f.miou))
        };
        let seconds = of(&|f| f.seconds);
        let per_view = of(&|f| of_views(f) / f.n_photos.max(1) as f64);
        let rest = of(&|f| (f.seconds - of_views(f)).max(0.0) / (f.n_gaussians.max(1) as f64 / 1e6));
        let bytes = of(&|f| f.bytes_per_gaussian);
        let mut settings: Vec<(f64, FrontSetting)> = Vec::new();
        for (((seconds, view), rest), bytes) in seconds.iter().zip(per_view).zip(rest).zip(bytes) {
            let point = seconds.point;
            let flags = [point.views.as_str(), point.lift.as_str()].join(" ");
            let is_of_machine = ["{", "--threads", "--device", "--every"].iter().any(|f| flags.contains(f));
            if is_of_machine || !point.eval.is_empty() {
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
                miou_spread: seconds.spread,
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

    /// Draws an accuracy against a cost, mean and standard deviation over scenes: a series per axis of the grid,
    /// and the Pareto front as a staircase.
    fn svg(&self, title: &str, scenes: &[&str], cost: &Measure, accuracy: &Measure) -> Option<String> {
        let means = means(&self.figures, scenes, cost.of, accuracy.of);
        if means.is_empty() {
            return None;
        }
        let series_of = |name: &str, style| Series {
            name: name.into(),
            style,
            points: Vec::new(),
            labels: Vec::new(),
            spreads: Vec::new(),
        };
        let mut series: Vec<Series> = Vec::new();
        for mean in &means {
            let axis = &mean.point.axis;
            let at = series.iter().position(|series| series.name == *axis).unwrap_or_else(|| {
                let style = if self.ordered.contains(axis) { Style::Line } else { Style::Points };
                series.push(series_of(axis, style));
                series.len() - 1
            });
            series[at].points.push((mean.cost, mean.accuracy));
            series[at].labels.push(mean.point.name.clone());
            if scenes.len() > 1 {
                series[at].spreads.push(mean.spread);
            }
        }
        let all: Vec<(f64, f64)> = means.iter().map(|mean| (mean.cost, mean.accuracy)).collect();
        let mut front: Vec<(f64, f64)> =
            all.iter().zip(pareto(&all)).filter(|(_, front)| *front).map(|(point, _)| *point).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        front.dedup();
        series.push(Series { points: front, ..series_of("Pareto front", Style::Steps) });
        let spread = match scenes.len() {
            1 => String::new(),
            n => format!(" Mean and standard deviation over {n} scenes."),
        };
        let plot = Plot {
            title: format!("{title}: accuracy against {}", cost.axis),
            note: format!("{}, {} threads.{spread}", self.machine.cpu, self.machine.n_threads),
            across: cost.axis,
            up: accuracy.axis,
        };
        Some(plot.svg(&series))
    }
}

impl fmt::Display for TradeoffReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Pareto-optimal in mIoU and seconds (s), bytes (b), query time (q) of its scene.\n")?;
        let columns =
            ["scene", "", "axis", "point", "seconds", "views", "masks", "mIoU", "mAcc", "AP", "AUC"];
        let mut table = Table::new(columns.into_iter().chain(["bytes/G", "query ms"]));
        for scene in self.scenes() {
            let of_scene: Vec<&Figures> = self.figures.iter().filter(|f| f.scene == scene).collect();
            let fronts = COSTS.each_ref().map(|cost| {
                // A point without this cost is never optimal.
                let value = |f: &&Figures| (cost.of)(f).map_or((f64::MAX, f64::MIN), |v| (v, f.miou));
                let points: Vec<(f64, f64)> = of_scene.iter().map(value).collect();
                let on_front =
                    pareto(&points).into_iter().zip(&points).map(|(is_on, p)| is_on && p.0 < f64::MAX);
                on_front.collect::<Vec<bool>>()
            });
            for (number, p) in of_scene.into_iter().enumerate() {
                let marks = ["s", "b", "q"].into_iter().zip(&fronts).filter(|(_, front)| front[number]);
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
                    figure(p.query_ms),
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
