//! The picture from which a user picks a setting.

use super::grid::Point;
use super::means::means;
use super::paper::PAPER;
use super::report::{Measure, TradeoffReport, pareto};
use crate::bench::plot::{Plot, Scale, Series, Style};

impl TradeoffReport {
    /// Draws an accuracy against a cost, mean and standard deviation over scenes: a series per axis of the grid, the Pareto
    /// front as a staircase, and beside times those of the paper.
    pub(super) fn svg(
        &self,
        title: &str,
        scenes: &[&str],
        cost: &Measure,
        accuracy: &Measure,
    ) -> Option<String> {
        let means = means(&self.figures, scenes, cost.of, accuracy.of);
        if means.is_empty() {
            return None;
        }
        // In the order of the grid.
        let mut series: Vec<Series> = Vec::new();
        for mean in &means {
            let axis = &mean.point.axis;
            if !series.iter().any(|series| series.name == *axis) {
                let style = if self.ordered.contains(axis) { Style::Line } else { Style::Points };
                let empty = (Vec::new(), Vec::new(), Vec::new());
                let (points, labels, spreads) = empty;
                series.push(Series { name: axis.clone(), style, points, labels, spreads });
            }
            if let Some(of_axis) = series.iter_mut().find(|series| series.name == *axis) {
                of_axis.points.push((mean.cost, mean.accuracy));
                of_axis.labels.push(label(mean.point));
                if mean.n_scenes > 1 {
                    of_axis.spreads.push(mean.spread);
                }
            }
        }
        let all: Vec<(f64, f64)> = means.iter().map(|mean| (mean.cost, mean.accuracy)).collect();
        let mut front: Vec<(f64, f64)> =
            all.iter().zip(pareto(&all)).filter(|(_, front)| *front).map(|(point, _)| *point).collect();
        front.sort_by(|a, b| a.0.total_cmp(&b.0));
        front.dedup();
        series.push(Series {
            name: "Pareto front".into(),
            style: Style::Steps,
            points: front,
            labels: Vec::new(),
            spreads: Vec::new(),
        });
        let spread = match scenes.len() {
            1 => String::new(),
            n => format!(" Mean and standard deviation over {n} scenes."),
        };
        let plot = Plot {
            title: format!("{title}: accuracy against {}", cost.axis),
            note: format!("{}, {} threads.{spread}", self.machine.cpu, self.machine.n_threads),
            across: cost.axis,
            up: accuracy.axis,
            up_scale: Scale::Linear,
        };
        let beside = (cost.file == "seconds" && accuracy.file.is_empty()).then(|| {
            let plot = Plot {
                title: "the paper: SAM grid / image step".into(),
                note: "Szilagyi et al. 2025, RA-L: ScanNet scene0000_00, 19 classes, 16 A100.".into(),
                across: "seconds",
                up: "mIoU, percent",
                up_scale: Scale::Linear,
            };
            let series = Series {
                name: "paper".into(),
                style: Style::Crosses,
                points: PAPER.iter().map(|row| (row.seconds, row.miou_percent)).collect(),
                labels: PAPER.iter().map(|row| row.configuration.to_owned()).collect(),
                spreads: Vec::new(),
            };
            (plot, [series])
        });
        Some(plot.svg_beside(&series, beside.as_ref().map(|(plot, series)| (plot, &series[..]))))
    }
}

/// Returns a point's label. Presets speak for themselves; other names say little without their axis, which is the
/// colour's.
fn label(point: &Point) -> String {
    point.name.clone()
}
