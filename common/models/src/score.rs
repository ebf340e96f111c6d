//! The interpretation of a model's scores.

use std::fmt;

use serde::Deserialize;

/// The interpretation of scores: as a cosine, or as the sigmoid of a scaled cosine.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScoreDescription {
    /// The cosine from which something counts as found, by default.
    threshold: Option<f32>,
    /// The factor from cosine to logit.
    logit_scale: Option<f64>,
    logit_bias: Option<f64>,
    /// The probability from which something counts as found, by default.
    probability: Option<f64>,
}

/// Shows the fields that are given.
impl fmt::Display for ScoreDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { threshold, logit_scale, logit_bias, probability } = *self;
        let given = [
            ("threshold", threshold.map(f64::from)),
            ("logit_scale", logit_scale),
            ("logit_bias", logit_bias),
            ("probability", probability),
        ];
        let given = given.into_iter().filter_map(|(name, value)| Some(format!("{name} = {}", value?)));
        f.write_str(&given.collect::<Vec<_>>().join(", "))
    }
}

impl ScoreDescription {
    /// Returns the cosine from which something counts as found: the threshold, or the solution of
    /// 1 / (1 + exp(-(scale * cosine + bias))) = probability (Zhai et al. 2023, equation 1).
    ///
    /// `None` if the fields are not those of exactly one of the two, or give no cosine.
    pub fn threshold(&self) -> Option<f32> {
        let threshold = match *self {
            Self { threshold, logit_scale: None, logit_bias: None, probability: None } => {
                f64::from(threshold?)
            }
            Self { threshold: None, logit_scale, logit_bias, probability } => {
                let probability = probability.unwrap_or(0.5);
                ((probability / (1.0 - probability)).ln() - logit_bias?) / logit_scale.filter(|s| *s > 0.0)?
            }
            _ => return None,
        };
        (-1.0..=1.0).contains(&threshold).then_some(threshold as f32)
    }
}
