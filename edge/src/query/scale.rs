//! The scale of reported scores: cosines, or relevancies with negatives.

use schemars::JsonSchema;
use serde::Serialize;
use slag_common::manifest::{Calibration, Manifest};

use super::request::QueryRequest;
use crate::score::{Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};

/// Meaning of scores and thresholds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ScoreKind {
    /// `q · E_k`, -1..1.
    Cosine,
    /// `1 / (1 + exp(-10 (q · E_k - max_j n_j · E_k)))`, 0..1.
    Relevancy,
}

#[derive(Clone, Copy)]
pub struct Scale(pub ScoreKind);

impl Scale {
    pub fn of(question: &Question) -> Self {
        Self(if question.negatives.is_empty() { ScoreKind::Cosine } else { ScoreKind::Relevancy })
    }

    /// Returns the threshold and its source. `calibration`: mean and spread of a bank of texts' scores.
    pub fn threshold(
        self,
        request: &QueryRequest,
        manifest: &Manifest,
        calibration: Option<Calibration>,
    ) -> (f32, ThresholdSource) {
        match (request.threshold, self.0) {
            (Some(threshold), _) => (threshold, ThresholdSource::Request),
            (None, ScoreKind::Relevancy) => (RELEVANCY_THRESHOLD, ThresholdSource::Relevancy),
            (None, ScoreKind::Cosine) => {
                // An encoder without calibration states its threshold itself, and a cosine is a cosine.
                let scene = manifest.encoder.calibration.and(calibration);
                calibrated_threshold(manifest.encoder.default_threshold, scene)
            }
        }
    }

    /// Returns the reported score of an unrelated thing: 0 for a relevancy; for a cosine the mean of a bank of texts'
    /// scores over whatever is scored, or 0 if not measured.
    pub fn base(self, calibration: Option<Calibration>) -> f32 {
        match self.0 {
            ScoreKind::Cosine => calibration.map_or(0.0, |measured| measured.score_mean),
            ScoreKind::Relevancy => 0.0,
        }
    }

    pub fn shown(self, score: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => score,
            ScoreKind::Relevancy => relevancy(score),
        }
    }

    pub(crate) fn to_score(self, shown: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => shown,
            ScoreKind::Relevancy => score_of_relevancy(shown),
        }
    }

    pub(crate) fn error_bound(self, of_score: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => of_score,
            // A sigmoid is nowhere steeper than a quarter of its steepness at 0.
            ScoreKind::Relevancy => (of_score * RELEVANCY_STEEPNESS / 4.0 + f32::EPSILON).min(1.0),
        }
    }
}

/// Spreads above the mean of a scene's own threshold. On the labelled house with ConSE vectors (1,500 Gaussians,
/// 1,612 texts: mean 0.002, spread 0.118) the mean F1 over its words peaks at 3 spreads, 0.355, where 1.2 % of all
/// pairs of text and Gaussian match.
const SPREADS_ABOVE_MEAN: f32 = 3.0;
/// A smaller spread is unusable: all Gaussians look alike, or hardly any were scored.
const MIN_SPREAD: f32 = 1e-3;

/// Threshold for questions with negatives: the thing asked for is closer than any negative (LERF's own choice).
pub const RELEVANCY_THRESHOLD: f32 = 0.5;

/// Source of a threshold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ThresholdSource {
    /// The request states it.
    Request,
    /// The scene's calibration: the mean score of a text bank plus three spreads.
    Scene,
    /// The encoder's description, because the scene was not calibrated.
    Encoder,
    /// Relevancy 0.5: closer to the thing asked for than to any negative.
    Relevancy,
}

/// Returns the default cosine threshold: three spreads above the scene's mean; if uncalibrated, the encoder's.
pub fn calibrated_threshold(encoder_default: f32, scene: Option<Calibration>) -> (f32, ThresholdSource) {
    let of_scene = |c: Calibration| c.score_mean + SPREADS_ABOVE_MEAN * c.score_spread;
    let usable = scene.filter(|c| c.score_spread >= MIN_SPREAD && (-1.0..=1.0).contains(&of_scene(*c)));
    usable.map_or((encoder_default, ThresholdSource::Encoder), |c| (of_scene(c), ThresholdSource::Scene))
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    /// Background scores are shifted and stretched as by different encoders, with 40 Gaussians each of 5 things six
    /// spreads above: the threshold finds nearly all of those and hardly anything else.
    #[test]
    fn follows_the_encoder_that_scored() {
        let mut random = Random::new(6);
        for (shift, stretch) in [(0.0f32, 0.12f32), (0.21, 0.025), (-0.1, 0.05)] {
            // The sum of 12 uniform numbers has a spread of 2 and is nearly normal.
            let mut background = || (0..12).map(|_| random.signed()).sum::<f32>() / 2.0 * stretch + shift;
            let mut pairs: Vec<(f32, bool)> = (0..20_000).map(|_| (background(), false)).collect();
            pairs.extend((0..200).map(|_| (background() + 6.0 * stretch, true)));
            let n = pairs.len() as f32;
            let score_mean = pairs.iter().map(|p| p.0).sum::<f32>() / n;
            let variance = pairs.iter().map(|p| (p.0 - score_mean).powi(2)).sum::<f32>() / n;
            let scene = Calibration { score_mean, score_spread: variance.sqrt() };
            let (threshold, source) = calibrated_threshold(0.35, Some(scene));
            assert_eq!(source, ThresholdSource::Scene);
            let share = |wanted: bool| {
                let of_kind: Vec<f32> = pairs.iter().filter(|p| p.1 == wanted).map(|p| p.0).collect();
                of_kind.iter().filter(|score| **score >= threshold).count() as f32 / of_kind.len() as f32
            };
            assert!(share(true) > 0.95 && share(false) < 0.01, "{} {}", share(true), share(false));
        }
    }

    #[test]
    fn without_a_measurement_the_encoder_decides() {
        let unusable =
            [(0.1, 0.0), (0.1, -1.0), (f32::NAN, 0.1), (0.1, f32::NAN), (0.1, f32::INFINITY), (0.9, 0.1)];
        let scenes =
            unusable.map(|(score_mean, score_spread)| Some(Calibration { score_mean, score_spread }));
        for scene in scenes.into_iter().chain([None]) {
            assert_eq!(calibrated_threshold(0.35, scene), (0.35, ThresholdSource::Encoder), "{scene:?}");
        }
    }
}
