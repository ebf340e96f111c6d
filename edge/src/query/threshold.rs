//! Default thresholds and their sources.

use schemars::JsonSchema;
use serde::Serialize;
use slag_common::manifest::Calibration;

/// A smaller spread is unusable: all Gaussians look alike, or hardly any were scored.
const MIN_SPREAD: f32 = 1e-3;

/// Threshold for questions with negatives: the thing asked for is closer than any negative (LERF's own
/// choice).
pub const RELEVANCY_THRESHOLD: f32 = 0.5;

/// Source of a threshold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ThresholdSource {
    /// The request states it.
    Request,
    /// The scene's calibration: hardly any text of what is absent scores as high anywhere.
    Scene,
    /// The encoder's description, because the scene was not calibrated.
    Encoder,
    /// Relevancy 0.5: closer to the thing asked for than to any negative.
    Relevancy,
}

/// Returns the default cosine threshold: the scene's, or the encoder's own default if the scene has no usable
/// calibration.
pub fn calibrated_threshold(encoder_default: f32, scene: Option<Calibration>) -> (f32, ThresholdSource) {
    let usable = scene.filter(|c| c.score_spread >= MIN_SPREAD && (-1.0..=1.0).contains(&c.threshold()));
    usable.map_or((encoder_default, ThresholdSource::Encoder), |c| (c.threshold(), ThresholdSource::Scene))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Random;

    /// Background scores are shifted and stretched as different encoders do, with 40 Gaussians each of 5
    /// things six spreads above: the threshold finds nearly all of those and hardly anything else.
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
