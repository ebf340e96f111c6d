//! The scale on which scores are reported: cosines, or relevancies where there are negatives.

use slag_common::manifest::{Calibration, Manifest};

use super::answers::ScoreKind;
use super::request::QueryRequest;
use super::threshold::{RELEVANCY_THRESHOLD, ThresholdSource, calibrated_threshold};
use crate::score::{Question, RELEVANCY_STEEPNESS, relevancy, score_of_relevancy};

/// Scale of the reported scores.
#[derive(Clone, Copy)]
pub struct Scale(pub ScoreKind);

impl Scale {
    pub fn of(question: &Question) -> Self {
        Self(if question.negatives.is_empty() { ScoreKind::Cosine } else { ScoreKind::Relevancy })
    }

    /// Returns the threshold and its source. `calibration`: mean and spread of a bank of texts' scores over
    /// whatever is scored.
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

    /// Returns the reported score of what has nothing to do with the question: 0 for a relevancy; for a cosine the
    /// mean of a bank of texts' scores over whatever is scored, or 0 if it was not measured.
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
