//! Tables and plots of a measured grid.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::error::TradeoffError;
use super::figures::Figures;
use super::paper::PaperRow;
use super::prediction::{Prediction, Ratios};
use crate::bench::machine::Machine;
use slag_encoder::html::Page;

/// Figures of a measured grid.
#[derive(Clone, Debug, Serialize)]
pub struct TradeoffReport {
    /// The machine.
    pub machine: Machine,
    /// The paper's table, on its machine and scene.
    pub paper: [PaperRow; 4],
    /// Axes whose points ascend.
    pub ordered: Vec<String>,
    /// All points, in the order of scenes and grid.
    pub figures: Vec<Figures>,
    /// Points left out because a scene lacks their data.
    pub left_out: Vec<String>,
    /// How well each scene's costs follow from the other scenes; empty for one scene.
    pub predictions: Vec<Prediction>,
}

/// A cost or an accuracy, for one axis of a plot.
pub(super) struct Measure {
    /// Part of the plots' file names.
    pub(super) file: &'static str,
    pub(super) axis: &'static str,
    pub(super) of: fn(&Figures) -> Option<f64>,
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

/// Returns which (cost, accuracy) points are Pareto-optimal: no other point is at least as cheap and as accurate, and differs.
pub fn pareto(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
    points.iter().map(|point| !points.iter().any(|other| beats(other, point))).collect()
}

impl TradeoffReport {
    /// Writes `tradeoff.csv`, `tradeoff.json`, `tradeoff.txt`, `front.json`, the plots (one per scene, cost and accuracy,
    /// and of several scenes one of their mean), and `tradeoff.html`, which has the plots and tables in one page.
    pub(super) fn write(&self, out: &Path) -> Result<(), TradeoffError> {
        fs_err::write(out.join("tradeoff.csv"), self.csv())?;
        fs_err::write(
            out.join("tradeoff.json"),
            serde_json::to_vec_pretty(self).map_err(std::io::Error::from)?,
        )?;
        fs_err::write(out.join("tradeoff.txt"), self.to_string())?;
        let front = serde_json::to_vec_pretty(&self.front()).map_err(std::io::Error::from)?;
        fs_err::write(out.join("front.json"), front)?;
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
        page.value(&serde_json::to_value(self).map_err(std::io::Error::from)?);
        Ok(fs_err::write(out.join("tradeoff.html"), page.finish())?)
    }

    /// Returns the paper's encode times as a sentence.
    fn paper(&self) -> String {
        let seconds = self.paper.map(|row| row.seconds.to_string()).join(", ");
        format!(
            "For comparison, the paper (Szilagyi et al. 2025) reports encode times of {seconds} s, on other scenes and another \
             machine."
        )
    }

    pub(super) fn scenes(&self) -> Vec<&str> {
        let mut scenes: Vec<&str> = self.figures.iter().map(|f| f.scene.as_str()).collect();
        scenes.dedup();
        scenes
    }

    fn of(&self, scene: &str) -> Vec<&Figures> {
        self.figures.iter().filter(|f| f.scene == scene).collect()
    }

    /// Returns for each cost which points of a scene are Pareto-optimal.
    fn fronts(&self, scene: &str) -> Vec<Vec<bool>> {
        let of_cost = |cost: &Measure| {
            // A point without this cost is never optimal.
            let value = |f: &&Figures| (cost.of)(f).map_or((f64::MAX, f64::MIN), |value| (value, f.miou));
            let points: Vec<(f64, f64)> = self.of(scene).iter().map(value).collect();
            pareto(&points)
                .into_iter()
                .zip(&points)
                .map(|(front, point)| front && point.0 < f64::MAX)
                .collect()
        };
        COSTS.iter().map(of_cost).collect()
    }

    fn csv(&self) -> String {
        let quote = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
        let show = |value: Option<f64>| value.map_or(String::new(), |v| v.to_string());
        let mut out = String::from(
            "scene,axis,name,views flags,lift flags,eval flags,profile,views,masks,coverage,miou,macc,map,auc,\
             localised,iou on views,unknown words,seconds,seconds of views,seconds of coverage,bytes per Gaussian,\
             query ms\n",
        );
        for f in &self.figures {
            let p = &f.point;
            let texts =
                [&f.scene, &p.axis, &p.name, &p.views, &p.lift, &p.eval].map(|text| quote(text)).join(",");
            let figures = [
                p.profile.name().to_owned(),
                f.n_views.to_string(),
                f.n_masks.to_string(),
                show(f.coverage),
                f.miou.to_string(),
                f.macc.to_string(),
                show(f.map),
                show(f.auc),
                show(f.localised),
                show(f.iou_on_views),
                f.n_unknown_words.to_string(),
                f.seconds.to_string(),
                f.views_seconds.to_string(),
                f.coverage_seconds.to_string(),
                f.bytes_per_gaussian.to_string(),
                show(f.query_ms),
            ];
            out += &format!("{texts},{}\n", figures.join(","));
        }
        out
    }
}

impl fmt::Display for TradeoffReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let show = |value: Option<f64>, n: usize| value.map_or("-".into(), |v| format!("{v:.n$}"));
        for scene in self.scenes() {
            let fronts = self.fronts(scene);
            writeln!(f, "{scene}: Pareto-optimal in accuracy and seconds (s), bytes (b), query time (q)")?;
            writeln!(
                f,
                "{:<3} {:<20} {:<16} {:>8} {:>6} {:>7} {:>6} {:>6} {:>6} {:>6} {:>8} {:>8} {:>8}",
                "",
                "axis",
                "point",
                "seconds",
                "views",
                "masks",
                "mIoU",
                "mAcc",
                "AP",
                "AUC",
                "IoU 2D",
                "bytes/G",
                "query ms"
            )?;
            for (number, p) in self.of(scene).into_iter().enumerate() {
                let marks: String = ["s", "b", "q"]
                    .iter()
                    .zip(&fronts)
                    .filter(|(_, front)| front[number])
                    .map(|(m, _)| *m)
                    .collect();
                writeln!(
                    f,
                    "{marks:<3} {:<20} {:<16} {:>8.1} {:>6} {:>7} {:>6.3} {:>6.3} {:>6} {:>6} {:>8} {:>8.2} {:>8}",
                    p.point.axis,
                    p.point.name,
                    p.seconds,
                    p.n_views,
                    p.n_masks,
                    p.miou,
                    p.macc,
                    show(p.map, 3),
                    show(p.auc, 3),
                    show(p.iou_on_views, 3),
                    p.bytes_per_gaussian,
                    show(p.query_ms, 3)
                )?;
            }
        }
        for point in &self.left_out {
            writeln!(f, "not run: {point}")?;
        }
        for (what, of) in
            [("seconds", Prediction::seconds as fn(&Prediction) -> f64), ("bytes", Prediction::bytes)]
        {
            if let Some(ratios) = Ratios::of(self.predictions.iter().map(of)) {
                writeln!(
                    f,
                    "{what} of a scene predicted from the others, as --target-{what} does: {ratios}"
                )?;
            }
        }
        let unknown = self.figures.iter().map(|f| f.n_unknown_words).max().unwrap_or(0);
        if unknown > 0 {
            writeln!(f, "{unknown} words are unknown to the encoder and left out of the means")?;
        }
        writeln!(f, "{}", self.paper())
    }
}
