//! Settings of the refinements, and the two presets.

use serde::{Deserialize, Serialize};

/// Least base of a mask's weight: a mask that is wholly cut off or contradicted still gives its Gaussians evidence.
pub(super) const LEAST_MASK_WEIGHT: f32 = 0.01;

/// How the contributions of all views become embeddings. The default is the paper's weighted average.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Aggregation {
    /// Drops contributions below this share of the Gaussian's largest in the same view, 0..=1.
    pub min_region_share: f32,
    /// Drops views in which a Gaussian has less than this share of its weight in its best view, 0..=1.
    pub min_view_share: f32,
    /// Gaussians with less weight over all views have no evidence, pixels.
    pub min_weight_px: f32,
    /// Each mask counts (1 - truncation)^`truncation_power`. A mask's truncation is the share of its outline that
    /// the photo's edge cuts off.
    pub truncation_power: f32,
    /// Each view contributes weight^(1 - `equalisation`): 0 weighs views by projected area, 1 weighs them equally.
    pub equalisation: f32,
    /// Each mask counts its agreement to this power: its mean cosine with the embeddings that other views give its
    /// Gaussians.
    pub agreement: f32,
    /// Steps (Weiszfeld 1937) from the mean of a Gaussian's views to their geometric median.
    pub median_steps: u32,
    /// Weight of the superpoint's mean, relative to the Gaussian's own.
    pub superpoint: f32,
    /// Weight of the larger superpoint's mean, relative to the result so far.
    pub coarse: f32,
    /// Weight of the mean of the Gaussian's object, relative to the result so far.
    pub object: f32,
    /// Whether Gaussians without evidence take their superpoint's mean.
    pub fill: bool,
}

impl Aggregation {
    /// The paper's weighted average.
    pub const PLAIN: Self = Self {
        min_region_share: 0.0,
        min_view_share: 0.0,
        min_weight_px: 0.0,
        truncation_power: 0.0,
        equalisation: 0.0,
        agreement: 0.0,
        median_steps: 0,
        superpoint: 0.0,
        coarse: 0.0,
        object: 0.0,
        fill: false,
    };
    /// The refinements that help both on trained splats and on generated ones (docs/accuracy.md). Pruning by region helps
    /// the trained ones, whose Gaussians lie across outlines, but costs the generated ones more. Agreement costs AP on
    /// trained splats; larger shares of superpoints smooth small things away.
    pub const REFINED: Self = Self {
        min_view_share: 0.05,
        truncation_power: 2.0,
        superpoint: 1.5,
        coarse: 0.5,
        object: 0.25,
        fill: true,
        ..Self::PLAIN
    };

    /// Returns the plain average, each refinement alone, and the refined preset: the rows of the comparison tables.
    pub fn methods() -> Vec<(&'static str, Self)> {
        let (plain, refined) = (Self::PLAIN, Self::REFINED);
        vec![
            ("plain", plain),
            ("regions", Self { min_region_share: 0.5, ..plain }),
            ("views", Self { min_view_share: refined.min_view_share, ..plain }),
            ("gate", Self { min_weight_px: 1.0, ..plain }),
            ("truncation", Self { truncation_power: refined.truncation_power, ..plain }),
            ("equalisation", Self { equalisation: 0.5, ..plain }),
            ("agreement", Self { agreement: 0.5, ..plain }),
            ("median", Self { median_steps: 3, ..plain }),
            ("superpoints", Self { superpoint: refined.superpoint, ..plain }),
            ("coarse", Self { coarse: refined.coarse, ..plain }),
            ("fill", Self { fill: true, ..plain }),
            ("refined", refined),
        ]
    }

    /// Returns whether the finer superpoints are found.
    pub fn has_fine_superpoints(&self) -> bool {
        self.superpoint > 0.0 || self.fill
    }

    /// Returns whether Gaussians share evidence within superpoints.
    pub(super) fn needs_superpoints(&self) -> bool {
        self.has_fine_superpoints() || self.coarse > 0.0
    }

    /// Returns whether Gaussians share evidence at all.
    pub(super) fn needs_mixtures(&self) -> bool {
        self.needs_superpoints() || self.object > 0.0
    }

    /// Returns whether the vectors of regions are needed, in principal coordinates.
    pub(super) fn needs_points(&self) -> bool {
        self.agreement != 0.0 || self.median_steps != 0 || self.needs_mixtures()
    }
}
