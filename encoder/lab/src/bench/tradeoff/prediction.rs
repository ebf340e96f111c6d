//! How far the front's expectations are from what a scene that it has not seen takes.

use std::fmt;

use serde::Serialize;

use super::costs::FrontCosts;
use super::figures::Figures;

/// A point on a scene, predicted from the other scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Prediction {
    /// The scene that was left out.
    pub scene: String,
    /// The point's axis.
    pub axis: String,
    /// Its name.
    pub name: String,
    /// Predicted seconds over measured ones.
    pub seconds_ratio: f64,
    /// Predicted bytes over measured ones.
    pub bytes_ratio: f64,
}

impl Prediction {
    pub(super) fn seconds(&self) -> f64 {
        self.seconds_ratio
    }

    pub(super) fn bytes(&self) -> f64 {
        self.bytes_ratio
    }
}

/// Predicts each point on each scene from the same point on all other scenes, as `encode --front` does.
pub(super) fn predictions(figures: &[Figures]) -> Vec<Prediction> {
    let of_point = |f: &Figures| {
        let others: Vec<FrontCosts> =
            figures.iter().filter(|o| o.point == f.point && o.scene != f.scene).map(FrontCosts::of).collect();
        let costs = FrontCosts::mean(&others)?;
        Some(Prediction {
            scene: f.scene.clone(),
            axis: f.point.axis.clone(),
            name: f.point.name.clone(),
            seconds_ratio: costs.seconds(f.n_photos, f.n_gaussians) / f.seconds,
            bytes_ratio: costs.bytes_per_gaussian / f.bytes_per_gaussian,
        })
    };
    figures.iter().filter_map(of_point).collect()
}

/// Quotients of predicted and measured costs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ratios {
    n: usize,
    least: f64,
    median: f64,
    largest: f64,
}

impl Ratios {
    /// Summarises quotients; `None` without any.
    pub(super) fn of(ratios: impl Iterator<Item = f64>) -> Option<Self> {
        let mut ratios: Vec<f64> = ratios.filter(|ratio| ratio.is_finite()).collect();
        ratios.sort_unstable_by(f64::total_cmp);
        let (least, largest) = (*ratios.first()?, *ratios.last()?);
        Some(Self { n: ratios.len(), least, median: ratios[(ratios.len() - 1) / 2], largest })
    }
}

impl fmt::Display for Ratios {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { n, least, median, largest } = self;
        write!(
            f,
            "predicted/measured {median:.2} in the median, {least:.2} to {largest:.2} ({n} predictions)"
        )
    }
}
