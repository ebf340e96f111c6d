//! Flags of the refinements: how contributions become embeddings.

use clap::Args;

use crate::lift::Aggregation;

/// Changes to the preset's aggregation.
#[derive(Clone, Debug, Default, Args)]
pub struct RefineArgs {
    /// Drops contributions below this share of a Gaussian's largest in the same view
    #[arg(long, value_name = "SHARE", value_parser = share)]
    min_region_share: Option<f32>,
    /// Drops views in which a Gaussian has less than this share of its weight in its best view
    #[arg(long, value_name = "SHARE", value_parser = share)]
    min_view_share: Option<f32>,
    /// Least weight over all views that is evidence, pixels
    #[arg(long, value_name = "PX", value_parser = amount)]
    min_weight: Option<f32>,
    /// Each mask counts (1 - truncation)^POWER; truncation is the share of its outline that the photo's edge cuts off
    #[arg(long, value_name = "POWER", value_parser = amount)]
    truncation_power: Option<f32>,
    /// Each view contributes weight^(1 - SHARE): 0 weighs views by projected area, 1 weighs them equally
    #[arg(long, value_name = "SHARE", value_parser = share)]
    equalisation: Option<f32>,
    /// Each mask counts its agreement with other views to this power; 0 weighs masks equally
    #[arg(long, value_name = "POWER", value_parser = amount)]
    agreement: Option<f32>,
    /// Steps from the mean of a Gaussian's views to their geometric median
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100))]
    median_steps: Option<u32>,
    /// Weight of the superpoint's mean, relative to the Gaussian's own
    #[arg(long, value_name = "TIMES", value_parser = amount)]
    superpoint: Option<f32>,
    /// Weight of the larger superpoint's mean, relative to the result so far
    #[arg(long, value_name = "TIMES", value_parser = amount)]
    coarse: Option<f32>,
    /// Weight of the mean of the Gaussian's object, relative to the result so far
    #[arg(long, value_name = "TIMES", value_parser = amount)]
    object: Option<f32>,
    /// Whether Gaussians without evidence take their superpoint's mean
    #[arg(long, value_name = "BOOL")]
    fill: Option<bool>,
    /// Keeps the contributions of views, so that another encode of the same views (with another codebook, say) is quick
    #[arg(long)]
    pub keep_views: bool,
}

impl RefineArgs {
    /// Returns the preset's aggregation with these changes.
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
            object: self.object.unwrap_or(preset.object),
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
