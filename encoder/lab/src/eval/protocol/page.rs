//! One page that places figures beside the paper's rows.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Deserialize;

use super::Judged;

/// Scenes of LERF-OVS in the paper's order.
const SCENES: [&str; 4] = ["figurines", "teatime", "ramen", "waldo_kitchen"];

/// Rows of the paper's table on LERF-OVS (Szilagyi et al. 2025): mIoU and mAcc in percent, by scene and mean.
const LERF: [(&str, [f64; 5], [f64; 5]); 6] = [
    ("LangSplat", [10.16, 11.38, 7.92, 9.18, 9.66], [8.93, 20.34, 11.27, 9.09, 12.41]),
    ("LEGaussians", [17.99, 19.27, 15.79, 11.78, 16.21], [23.21, 27.12, 26.76, 18.18, 23.82]),
    ("SAGA", [15.71, 16.65, 19.53, 4.54, 14.11], [18.59, 17.08, 24.40, 5.57, 16.41]),
    ("Gaussian Grouping", [55.38, 33.82, 32.58, 30.02, 37.95], [76.61, 52.21, 54.45, 50.23, 58.38]),
    ("OpenGaussian", [39.29, 60.44, 31.01, 22.70, 38.36], [55.36, 76.27, 42.25, 31.82, 51.43]),
    ("SLAG", [48.10, 56.12, 24.76, 27.55, 39.13], [69.95, 81.68, 64.77, 48.88, 66.32]),
];

/// Rows of the paper's table on ScanNet: mIoU and mAcc in percent for 19, 15 and 10 classes.
const SCANNET: [(&str, [[f64; 2]; 3]); 6] = [
    ("LangSplat", [[3.78, 9.11], [5.35, 13.20], [8.40, 22.06]]),
    ("LEGaussians", [[3.84, 10.87], [9.01, 22.22], [12.82, 28.62]]),
    ("SAGA", [[7.02, 13.45], [7.83, 14.76], [9.84, 13.79]]),
    ("OpenGaussian", [[24.73, 41.54], [30.13, 48.25], [38.29, 55.19]]),
    ("SLAG", [[28.98, 43.40], [28.98, 44.26], [37.14, 54.80]]),
    ("SLAG, prediction filtering", [[37.54, 49.99], [37.71, 50.70], [45.46, 60.08]]),
];

/// What the page takes of a report of `eval scannet --json`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
pub struct ScannetMeans {
    /// Means over the scenes, of 19, 15 and 10 classes.
    pub means: Vec<Means>,
    /// The same after the prediction filter, where it was asked for.
    #[serde(default)]
    pub filtered_means: Option<Vec<Means>>,
    /// Scenes of the protocol that were not evaluated.
    #[serde(default)]
    pub missing_scenes: Vec<String>,
    /// Each scene.
    #[serde(default)]
    pub scenes: Vec<Scene>,
}

/// Means over a list of classes.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Means {
    /// Number of classes.
    pub n_classes: usize,
    /// Mean intersection over union.
    pub miou: Option<f64>,
    /// Mean accuracy.
    pub macc: Option<f64>,
}

/// Words of a scene that the encoder does not know.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Scene {
    /// The scene.
    pub scene: String,
    /// Words and reasons; they count as never found.
    #[serde(default)]
    pub unknown_words: BTreeMap<String, String>,
}

fn cell(value: Option<f64>) -> String {
    value.map_or("-".into(), |value| format!("{:.2}", 100.0 * value))
}

/// Returns the mean of values if there are any.
fn mean(values: &[Option<f64>]) -> Option<f64> {
    let known: Vec<f64> = values.iter().copied().collect::<Option<_>>()?;
    (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
}

/// Returns the page in Markdown. `frozen`: each LERF scene at the threshold of the others; `fixed`: at the paper's 0.28;
/// `scannet`: reports with the name of their row.
pub fn page(
    frozen: &[Judged],
    fixed: &BTreeMap<String, Judged>,
    scannet: &[(String, ScannetMeans)],
) -> String {
    let mut page = String::from("# Measured beside the paper\n\n");
    page += "The paper's rows: Szilagyi, Engelmann, Bohg, IEEE RA-L 2025, as printed there. Figures in percent.\n";
    if !frozen.is_empty() {
        lerf(&mut page, frozen, fixed);
    }
    if !scannet.is_empty() {
        self::scannet(&mut page, scannet);
    }
    page
}

fn lerf(page: &mut String, frozen: &[Judged], fixed: &BTreeMap<String, Judged>) {
    let frozen_by: BTreeMap<String, Judged> =
        frozen.iter().map(|judged| (judged.scene.clone(), judged.clone())).collect();
    let rows = [("measured, threshold of the other scenes", &frozen_by), ("measured, threshold 0.28", fixed)];
    for (name, of_paper, of) in [("mIoU", 0, miou as fn(&Judged) -> f64), ("mAcc at IoU 0.25", 1, accuracy)] {
        let _ = writeln!(
            page,
            "\n## LERF-OVS, {name}\n\n| | {} | mean |\n|---|---|---|---|---|---|",
            SCENES.join(" | ")
        );
        for (method, mious, maccs) in &LERF {
            let values = [mious, maccs][of_paper].map(|value| format!("{value:.2}"));
            let _ = writeln!(page, "| {method} | {} |", values.join(" | "));
        }
        for (method, judged) in rows.iter().filter(|(_, judged)| !judged.is_empty()) {
            let values = SCENES.map(|scene| judged.get(scene).map(of));
            let cells = values.map(cell).join(" | ");
            let _ = writeln!(page, "| **{method}** | {cells} | {} |", cell(mean(&values)));
        }
    }
    page.push_str("\nProtocol:\n");
    for Judged { scene, threshold, frozen_on, n_things, .. } in frozen {
        let scenes = frozen_on.join(", ");
        let _ = writeln!(
            page,
            "- {scene}: threshold {threshold} frozen on {scenes}; all {n_things} labelled things reported."
        );
    }
    page.push_str("- Frames are matched with cameras by name; a word that the encoder does not know counts as not found.\n");
    for scene in SCENES.iter().filter(|scene| !frozen_by.contains_key(**scene)) {
        let _ = writeln!(page, "- {scene} was not evaluated, so there is no mean.");
    }
}

fn miou(judged: &Judged) -> f64 {
    judged.miou
}

fn accuracy(judged: &Judged) -> f64 {
    judged.accuracy
}

fn scannet(page: &mut String, reports: &[(String, ScannetMeans)]) {
    page.push_str("\n## ScanNet, argmax: mIoU, mAcc\n\n| | 19 | 15 | 10 |\n|---|---|---|---|\n");
    for (method, subsets) in &SCANNET {
        let cells = subsets.map(|[miou, macc]| format!("{miou:.2} {macc:.2}"));
        let _ = writeln!(page, "| {method} | {} |", cells.join(" | "));
    }
    for (name, report) in reports {
        let rows = [("", Some(&report.means)), (", prediction filtering", report.filtered_means.as_ref())];
        for (filter, means) in rows.into_iter().filter_map(|(filter, means)| Some((filter, means?))) {
            let cells = [0, 1, 2].map(|at| match means.get(at) {
                Some(means) => format!("{} {}", cell(means.miou), cell(means.macc)),
                None => "-".into(),
            });
            let _ = writeln!(page, "| **measured: {name}{filter}** | {} |", cells.join(" | "));
        }
    }
    for (name, report) in reports {
        if !report.missing_scenes.is_empty() {
            let missing = report.missing_scenes.join(", ");
            let _ = writeln!(
                page,
                "\n{name}: these scenes of the protocol were not evaluated, so the means are of others: {missing}."
            );
        }
        for Scene { scene, unknown_words } in
            report.scenes.iter().filter(|scene| !scene.unknown_words.is_empty())
        {
            let words: Vec<&str> = unknown_words.keys().map(String::as_str).collect();
            let _ = writeln!(
                page,
                "\n{name}, {scene}: never found, because the encoder does not know them: {}.",
                words.join(", ")
            );
        }
    }
}
