//! Flags of how sums become embeddings.

use clap::Args;

use crate::lift::Aggregation;

/// What is done beyond the preset's way to aggregate.
#[derive(Clone, Debug, Default, Args)]
pub struct RefineArgs {
    /// Leaves out sums below this part of a Gaussian's largest in the same view; the preset's if absent.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    min_region_share: Option<f32>,
    /// Leaves out views in which a Gaussian has less than this part of its weight in the best.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    min_view_share: Option<f32>,
    /// Gaussians with less weight over all views, pixels, have no evidence.
    #[arg(long, value_name = "PX", value_parser = amount)]
    min_weight: Option<f32>,
    /// Each mask counts (1 - truncation)^POWER; truncation is the share of its outline that the photo's edge cuts off
    #[arg(long, value_name = "POWER", value_parser = amount)]
    truncation_power: Option<f32>,
    /// 0: views count the solid angle that they see of a Gaussian; 1: all alike.
    #[arg(long, value_name = "SHARE", value_parser = share)]
    equalisation: Option<f32>,
    /// A mask counts its agreement with other views to this power; 0: all count alike.
    #[arg(long, value_name = "POWER", value_parser = amount)]
    agreement: Option<f32>,
    /// Steps from the mean of a Gaussian's views to their median.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100))]
    median_steps: Option<u32>,
    /// What a superpoint's mean counts beside a Gaussian's own, which counts 1.
    #[arg(long, value_name = "TIMES", value_parser = amount)]
    superpoint: Option<f32>,
    /// What the mean of a larger superpoint counts beside what came of that.
    #[arg(long, value_name = "TIMES", value_parser = amount)]
    coarse: Option<f32>,
    /// Whether Gaussians without evidence take their superpoint's.
    #[arg(long, value_name = "BOOL")]
    fill: Option<bool>,
    /// Keeps what the views left behind, so that another encode of the same, with another codebook say, is quick.
    #[arg(long)]
    pub keep_views: bool,
}

impl RefineArgs {
    /// Returns the preset's way with these flags' changes.
    pub fn aggregation(&self, preset: Aggregation) -> Aggregation {
        Aggregation {
            min_region_share: self.min_region_share.unwrap_or(preset.min_region_share),
            min_view_share: self.min_view_share.unwrap_or(preset.min_view_share),
            min_weight_px: self.min_weight.unwrap_or(preset.min_weight_px),
            truncation_power: self.truncation_power.unwrap_or(preset.truncation_power),
            equalisation: self.equalisation.unwrap_or(preset.equalisation),
            agreement: self.agreement.unwrap_or(preset.agreement),
            median_steps: self.median_steps.unwrap_or(preset.median_steps),
            superpoint: self.superpoint.unwrap_or(preset.superpoint),
            coarse: self.coarse.unwrap_or(preset.coarse),
            fill: self.fill.unwrap_or(preset.fill),
        }
    }
}

fn share(text: &str) -> Result<f32, String> {
    amount(text).and_then(|x| if x <= 1.0 { Ok(x) } else { Err(format!("{x} is not in 0..=1")) })
}

fn amount(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    if (0.0..=1000.0).contains(&value) { Ok(value) } else { Err(format!("{value} is not in 0..=1000")) }
}
