//! The measured front of settings, and the choice of one for a target of seconds or bytes.
//!
//! `slag-lab bench tradeoff` writes it. Seconds of the views grow with their number, all others with the number of
//! Gaussians. Photos of another size, other models or another machine need a front of their own.

use std::io;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use slag_common::files;
use slag_common::shard::Profile;

/// Settings that no other beats, and what they cost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Front {
    pub machine: String,
    /// Version and models.
    pub measured_with: String,
    pub n_scenes: usize,
    pub settings: Vec<FrontSetting>,
}

/// A setting and its figures, means over scenes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrontSetting {
    pub name: String,
    pub flags: String,
    /// The profile whose bytes and accuracy these are.
    pub profile: Profile,
    /// Seconds per photo of the scene, used or not.
    pub seconds_per_view: f64,
    pub seconds_per_million_gaussians: f64,
    pub bytes_per_gaussian: f64,
    pub miou: f64,
}

/// At least one of the two.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Target {
    pub seconds: Option<f64>,
    pub bytes: Option<u64>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Expectation {
    pub setting: FrontSetting,
    pub seconds: f64,
    pub bytes: f64,
}

impl Front {
    pub fn read(path: &Path) -> Result<Self> {
        let expected =
            || format!("{}: expected front.json as `slag-lab bench tradeoff` writes it", path.display());
        Self::parse(&io::read_to_string(files::open(path)?)?).with_context(expected)
    }

    fn parse(text: &str) -> Result<Self> {
        let front: Self = serde_json::from_str(text)?;
        ensure!(!front.settings.is_empty(), "no settings");
        for setting in &front.settings {
            let costs =
                [setting.seconds_per_view, setting.seconds_per_million_gaussians, setting.bytes_per_gaussian];
            let is_sound = costs.iter().all(|cost| (0.0..1e12).contains(cost));
            ensure!(is_sound, "{}: costs {costs:?}; expected 0 to 1e12", setting.name);
        }
        Ok(front)
    }

    /// Returns the most accurate setting expected to meet the target, the quicker one of equals.
    pub fn choose(&self, target: Target, n_photos: usize, n_gaussians: usize) -> Result<Expectation> {
        let expect = |setting: &FrontSetting| Expectation {
            seconds: setting.seconds_per_view * n_photos as f64
                + setting.seconds_per_million_gaussians * n_gaussians as f64 / 1e6,
            bytes: setting.bytes_per_gaussian * n_gaussians as f64,
            setting: setting.clone(),
        };
        let all: Vec<Expectation> = self.settings.iter().map(expect).collect();
        let meets = |e: &&Expectation| {
            target.seconds.is_none_or(|most| e.seconds <= most)
                && target.bytes.is_none_or(|most| e.bytes <= most as f64)
        };
        let best = all
            .iter()
            .filter(meets)
            .max_by(|a, b| a.setting.miou.total_cmp(&b.setting.miou).then(b.seconds.total_cmp(&a.seconds)));
        if let Some(best) = best {
            return Ok(best.clone());
        }
        let quickest = all.iter().min_by(|a, b| a.seconds.total_cmp(&b.seconds)).context("no settings")?;
        let smallest = all.iter().min_by(|a, b| a.bytes.total_cmp(&b.bytes)).context("no settings")?;
        bail!(
            "no measured setting meets the target: the quickest, {}, is expected to take {:.1} s, the smallest, {}, {:.0} \
             bytes; raise the target",
            quickest.setting.name,
            quickest.seconds,
            smallest.setting.name,
            smallest.bytes
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_test_support::assert_error;

    fn setting(name: &str, per_view: f64, bytes: f64, miou: f64) -> FrontSetting {
        FrontSetting {
            name: name.into(),
            flags: "--preset fast".into(),
            profile: Profile::Compact,
            seconds_per_view: per_view,
            seconds_per_million_gaussians: 10.0,
            bytes_per_gaussian: bytes,
            miou,
        }
    }

    /// By hand: 100 photos and half a million Gaussians take 100 times the view's seconds, and 5 more.
    #[test]
    fn the_best_setting_within_the_target_is_chosen() {
        let settings = vec![
            setting("slow", 0.5, 5.0, 0.9),
            setting("quick", 0.1, 6.0, 0.7),
            setting("small", 0.3, 4.0, 0.8),
        ];
        let front = Front { machine: "m".into(), measured_with: "w".into(), n_scenes: 1, settings };
        let choose = |seconds, bytes| front.choose(Target { seconds, bytes }, 100, 500_000);
        let name = |seconds, bytes| choose(seconds, bytes).expect("in reach").setting.name;
        assert_eq!(name(Some(55.0), None), "slow");
        assert_eq!(name(Some(54.9), None), "small");
        assert_eq!(name(Some(34.9), None), "quick");
        assert_eq!(name(None, Some(2_499_999)), "small");
        assert_eq!(name(Some(1e9), Some(2_000_000)), "small");
        let chosen = choose(Some(60.0), None).expect("in reach");
        assert_eq!((chosen.seconds, chosen.bytes), (55.0, 2_500_000.0));
        assert_error(choose(Some(14.9), None), &["quick", "15.0 s", "2000000"]);
    }

    #[test]
    fn fronts_are_checked() {
        let refused = |text: &str| Front::parse(text).expect_err("malformed").to_string();
        assert!(refused("{}").contains("missing field"), "{}", refused("{}"));
        let empty = r#"{"machine": "", "measured_with": "", "n_scenes": 1, "settings": []}"#;
        assert!(refused(empty).contains("no settings"));
        let wrong = setting("wrong", -1.0, 5.0, 0.5);
        let mut front =
            Front { machine: "m".into(), measured_with: "w".into(), n_scenes: 1, settings: vec![wrong] };
        let text = serde_json::to_string(&front).expect("JSON");
        assert!(refused(&text).contains("expected 0 to"), "{}", refused(&text));
        front.settings[0].seconds_per_view = 1.0;
        let text = serde_json::to_string(&front).expect("JSON");
        assert_eq!(Front::parse(&text).expect("well-formed"), front);
    }
}
