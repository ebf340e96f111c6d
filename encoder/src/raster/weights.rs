//! The result of rasterising a view: the weight of each Gaussian in each region.

use slag_raster::ViewCounters;

/// Quantity that is summed over the pixels of a region.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
pub enum WeightKind {
    /// `alpha * T`: the Gaussian's contribution to the picture, attenuated by the Gaussians in front of it.
    Blend,
    /// `exp(-d' S^-1 d / 2)`, as printed in the paper: without opacity and occlusion. The footprint still ends
    /// where alpha falls below 1/255.
    Falloff,
}

/// Contribution of a Gaussian to a region: its weight summed over the pixels.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
pub struct RegionWeight {
    /// Index of the Gaussian in the scene.
    pub gaussian: u32,
    pub region: u32,
    /// Weight, pixels; above 0.
    pub weight: f32,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewWeights {
    /// Contributions above zero, ordered by (Gaussian, region); each pair occurs once.
    pub entries: Vec<RegionWeight>,
    pub counters: ViewCounters,
}
