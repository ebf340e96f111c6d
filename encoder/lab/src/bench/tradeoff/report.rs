//! Table of a measured grid, and the front that `slag-encoder encode --front` reads.

use std::fmt;
use std::path::Path;

use anyhow::Result;
use serde::{Deserialize, Serialize};
use slag_encoder::encode::front::{Front, FrontSetting};

use super::grid::Point;
use crate::harness::Machine;
use crate::table::{Table, figure};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Figures {
    pub(super) scene: String,
    #[serde(flatten)]
    pub(super) point: Point,
    /// Models, device and version; figures of others are not comparable.
    pub(super) made_by: String,
    /// Views of the scene with a photo, before any were chosen.
    pub(super) n_photos: u64,
    pub(super) n_gaussians: u64,
    pub(super) miou: f64,
    pub(super) map: Option<f64>,
    /// Seconds of the encode; those for the views; those for choosing the views.
    pub(super) seconds: f64,
    pub(super) views_seconds: f64,
    pub(super) coverage_seconds: f64,
    pub(super) bytes_per_gaussian: f64,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct TradeoffReport {
    pub(super) machine: Machine,
    pub(super) figures: Vec<Figures>,
    pub(crate) left_out: Vec<String>,
}

type Cost = fn(&Figures) -> f64;

const COSTS: [Cost; 2] = [|f| f.seconds, |f| f.bytes_per_gaussian];

/// Marks the Pareto-optimal (cost, accuracy) points: no different point is at least as cheap and as accurate.
pub(super) fn pareto(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
    points.iter().map(|point| !points.iter().any(|other| beats(other, point))).collect()
}

impl TradeoffReport {
    pub(super) fn write(&self, out: &Path) -> Result<()> {
        fs_err::write(out.join("tradeoff.json"), serde_json::to_vec_pretty(self)?)?;
        fs_err::write(out.join("tradeoff.md"), self.to_string())?;
        fs_err::write(out.join("front.json"), serde_json::to_vec_pretty(&self.front())?)?;
        Ok(())
    }

    fn scenes(&self) -> Vec<&str> {
        let mut scenes: Vec<&str> = self.figures.iter().map(|f| f.scene.as_str()).collect();
        scenes.dedup();
        scenes
    }

    /// Returns the figures of each point that all scenes have, in the order of the first scene.
    fn of_points(&self) -> Vec<Vec<&Figures>> {
        let scenes = self.scenes();
        let of_point = |first: &Figures| self.figures.iter().filter(|f| f.point == first.point).collect();
        let of_first = self.figures.iter().filter(|f| Some(&f.scene.as_str()) == scenes.first());
        of_first.map(of_point).filter(|of_point: &Vec<&Figures>| of_point.len() == scenes.len()).collect()
    }

    /// Returns the settings that no other beats in seconds or bytes, on the mean of the scenes. Leaves out points with
    /// placeholders or flags of the machine, which a user cannot give on every scene.
    fn front(&self) -> Front {
        let of_views = |f: &Figures| f.views_seconds + f.coverage_seconds;
        let mut settings: Vec<(f64, FrontSetting)> = Vec::new();
        for of_point in self.of_points() {
            let point = &of_point[0].point;
            let flags = [point.views.as_str(), point.lift.as_str()].join(" ");
            let is_of_machine = ["{", "--threads", "--device", "--every"].iter().any(|f| flags.contains(f));
            if is_of_machine {
                continue;
            }
            let mean = |of: &dyn Fn(&Figures) -> f64| {
                of_point.iter().map(|f| of(f)).sum::<f64>() / of_point.len() as f64
            };
            let millions = |f: &Figures| f.n_gaussians.max(1) as f64 / 1e6;
            let setting = FrontSetting {
                name: format!("{} / {}", point.axis, point.name),
                flags: flags.trim().to_owned(),
                profile: point.profile,
                seconds_per_view: mean(&|f| of_views(f) / f.n_photos.max(1) as f64),
                seconds_per_million_gaussians: mean(&|f| (f.seconds - of_views(f)).max(0.0) / millions(f)),
                bytes_per_gaussian: mean(&|f| f.bytes_per_gaussian),
                miou: mean(&|f| f.miou),
            };
            settings.push((mean(&|f| f.seconds), setting));
        }
        let of_seconds: Vec<(f64, f64)> = settings.iter().map(|(s, f)| (*s, f.miou)).collect();
        let of_bytes: Vec<(f64, f64)> =
            settings.iter().map(|(_, f)| (f.bytes_per_gaussian, f.miou)).collect();
        let on_front = pareto(&of_seconds).into_iter().zip(pareto(&of_bytes)).map(|(a, b)| a || b);
        let kept = settings.into_iter().zip(on_front).filter(|(_, is_on)| *is_on).map(|((_, f), _)| f);
        Front {
            machine: self.machine.to_string(),
            measured_with: self.figures.first().map_or(String::new(), |f| f.made_by.clone()),
            n_scenes: self.scenes().len(),
            settings: kept.collect(),
        }
    }
}

impl fmt::Display for TradeoffReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Pareto-optimal in mIoU and seconds (s), bytes (b) of its scene.\n")?;
        let mut table = Table::new(["scene", "", "axis", "point", "seconds", "mIoU", "AP", "bytes/G"]);
        for scene in self.scenes() {
            let of_scene: Vec<&Figures> = self.figures.iter().filter(|f| f.scene == scene).collect();
            let fronts = COSTS
                .map(|cost| pareto(&of_scene.iter().map(|f| (cost(f), f.miou)).collect::<Vec<(f64, f64)>>()));
            for (number, p) in of_scene.into_iter().enumerate() {
                let marks = ["s", "b"].into_iter().zip(&fronts).filter(|(_, front)| front[number]);
                table.row([
                    scene.to_owned(),
                    marks.map(|(mark, _)| mark).collect(),
                    p.point.axis.clone(),
                    p.point.name.clone(),
                    format!("{:.1}", p.seconds),
                    figure(Some(p.miou)),
                    figure(p.map),
                    format!("{:.2}", p.bytes_per_gaussian),
                ]);
            }
        }
        write!(f, "{table}")?;
        self.left_out.iter().try_for_each(|point| writeln!(f, "- not run: {point}"))
    }
}
