//! The measured front as a file that `slag-encoder encode --front` reads.

use slag_encoder::encode::front::{Front, FrontSetting};

use super::costs::FrontCosts;
use super::figures::Figures;
use super::means::means;
use super::report::{TradeoffReport, pareto};

impl TradeoffReport {
    /// Returns the settings that no other beats in seconds or bytes, on the mean of the scenes; only those that a user
    /// can give on any scene: without placeholders, flags of the evaluation, or a view of the machine.
    pub(super) fn front(&self) -> Front {
        let scenes = self.scenes();
        let per_view = |f: &Figures| Some(FrontCosts::of(f).seconds_per_view);
        let rest = |f: &Figures| Some(FrontCosts::of(f).seconds_per_million_gaussians);
        let miou = |f: &Figures| Some(f.miou);
        let seconds = means(&self.figures, &scenes, |f| Some(f.seconds), miou);
        let view_costs = means(&self.figures, &scenes, per_view, miou);
        let rests = means(&self.figures, &scenes, rest, miou);
        let bytes = means(&self.figures, &scenes, |f| Some(f.bytes_per_gaussian), miou);
        let mut settings: Vec<(f64, FrontSetting)> = Vec::new();
        for (((seconds, view), rest), bytes) in seconds.iter().zip(view_costs).zip(rests).zip(bytes) {
            let point = seconds.point;
            let flags = [point.views.as_str(), point.lift.as_str()].join(" ");
            let is_of_machine = flags.contains("--threads") || flags.contains("--device");
            if flags.contains('{') || !point.eval.is_empty() || is_of_machine || flags.contains("--every") {
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
        let machine = &self.machine;
        Front {
            machine: format!("{}, {} threads, {}", machine.cpu, machine.n_threads, machine.platform),
            measured_with: self.figures.first().map_or(String::new(), |f| f.made_by.clone()),
            n_scenes: scenes.len(),
            settings: kept.collect(),
        }
    }
}
