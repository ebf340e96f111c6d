//! Settings of the refinements, and the two presets.

use serde::{Deserialize, Serialize};

/// How the contributions of all views become embeddings. The default is the paper's weighted average.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Aggregation {
    /// Drops views in which a Gaussian has less than this share of its weight in its best view, 0..=1.
    pub(crate) min_view_share: f32,
    /// Each mask counts (1 - truncation)^`truncation_power`. A mask's truncation is the share of its outline that
    /// the photo's edge cuts off.
    pub(crate) truncation_power: f32,
    /// Weight of the superpoint's mean, relative to the Gaussian's own.
    pub(crate) superpoint: f32,
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
        min_view_share: 0.0,
        truncation_power: 0.0,
        superpoint: 0.0,
        coarse: 0.0,
        object: 0.0,
        fill: false,
    };
    /// The refinements that help on both trained and generated splats (docs/decisions.md). Larger shares of superpoints
    /// smooth small things away.
    pub(crate) const REFINED: Self = Self {
        min_view_share: 0.05,
        truncation_power: 2.0,
        superpoint: 1.5,
        coarse: 0.5,
        object: 0.25,
        fill: true,
    };

    pub(crate) fn has_fine_superpoints(&self) -> bool {
        self.superpoint > 0.0 || self.fill
    }

    pub(super) fn needs_superpoints(&self) -> bool {
        self.has_fine_superpoints() || self.coarse > 0.0
    }

    /// Gaussians share evidence, so vectors are needed in principal coordinates.
    pub(super) fn needs_mixtures(&self) -> bool {
        self.needs_superpoints() || self.object > 0.0
    }

    /// Partitions within which Gaussians share evidence.
    pub(super) fn n_partitions(&self) -> usize {
        self.n_scales() + usize::from(self.object > 0.0)
    }

    pub(super) fn n_scales(&self) -> usize {
        usize::from(self.has_fine_superpoints()) + usize::from(self.coarse > 0.0)
    }
}
