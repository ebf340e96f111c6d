//! The choices of an encode that a preset makes, flags override and a measured front knows.

use clap::Args;

use crate::encode::{EncodeSettings, Masks, Preset, RasterWidth, Regions, ViewOrder, ViewsLimit};

/// The choices, each the preset's where its flag is absent.
#[derive(Clone, Debug, Default, Args)]
#[group(id = "choices", multiple = true)]
pub(crate) struct ChoiceArgs {
    /// Bundle of choices; other flags override single choices.
    #[arg(long, value_enum, default_value_t, help_heading = "Speed and accuracy")]
    pub preset: Preset,
    /// Which parts of a photo get vectors: `masks`, from their crops and from what the photo shows in and around
    /// them (the image model's patches, or windows over the photo: image.patches and image.windows in model.toml);
    /// `crops`, masks from their crops alone; `patches`, without masks, so no objects are found [default: the
    /// preset's].
    #[arg(long, value_enum, help_heading = "Speed and accuracy", hide_short_help = true)]
    regions: Option<Regions>,
    /// Number or share of the views to use: the first ones of --view-order [default: the preset's].
    #[arg(long, value_name = "N|P%", value_parser = parse_views_limit, help_heading = "Speed and accuracy")]
    views_limit: Option<ViewsLimit>,
    /// Order in which views are taken [default: coverage with a limit or a budget, else names].
    #[arg(
        long,
        value_enum,
        value_name = "ORDER",
        help_heading = "Speed and accuracy",
        hide_short_help = true
    )]
    view_order: Option<ViewOrder>,
    /// Number of scales at which the built-in segmenter looks, coarsest first [default: the preset's].
    #[arg(long, value_name = "N", help_heading = "Speed and accuracy", hide_short_help = true)]
    pub(super) mask_levels: Option<usize>,
    /// Masks with fewer pixels are left out [default: the preset's].
    #[arg(long, value_name = "PX", help_heading = "Speed and accuracy", hide_short_help = true)]
    min_mask_px: Option<u32>,
    /// Width at which weights are rasterised: a number of pixels, or `photo` for the photo's own width, at most 1024
    /// [default: the preset's].
    #[arg(long, value_name = "photo|PX", value_parser = parse_raster_width, help_heading = "Speed and accuracy", hide_short_help = true)]
    raster_width: Option<RasterWidth>,
    /// Skips the search for objects: masks of different views that show the same Gaussians.
    #[arg(long, help_heading = "Speed and accuracy", hide_short_help = true)]
    no_objects: bool,
    /// Drops views in which a Gaussian has less than this share of its weight in its best view
    #[arg(long, value_name = "SHARE", help_heading = "Speed and accuracy", hide_short_help = true)]
    min_view_share: Option<f32>,
    /// Each mask counts (1 - truncation)^POWER; truncation is the share of its outline that the photo's edge cuts
    /// off
    #[arg(long, value_name = "POWER", help_heading = "Speed and accuracy", hide_short_help = true)]
    truncation_power: Option<f32>,
    /// Weight of the superpoint's mean, relative to the Gaussian's own
    #[arg(long, value_name = "TIMES", help_heading = "Speed and accuracy", hide_short_help = true)]
    superpoint: Option<f32>,
    /// Weight of the larger superpoint's mean, relative to the result so far
    #[arg(long, value_name = "TIMES", help_heading = "Speed and accuracy", hide_short_help = true)]
    coarse: Option<f32>,
    /// Whether Gaussians without evidence take their superpoint's mean
    #[arg(long, value_name = "BOOL", help_heading = "Speed and accuracy", hide_short_help = true)]
    fill: Option<bool>,
    /// Mean error of scores that the compact profile may have, relative to the spread of scores [default: the
    /// preset's].
    #[arg(long, value_name = "E", help_heading = "Speed and accuracy", hide_short_help = true)]
    compact_error: Option<f32>,
    /// Most components of a vector in compact and balanced shards, even [default: as many as the errors need, at
    /// most 128].
    #[arg(long, value_name = "N", help_heading = "Speed and accuracy", hide_short_help = true)]
    max_components: Option<usize>,
}

fn set<T: Clone>(to: &mut T, value: &Option<T>) {
    if let Some(value) = value {
        *to = value.clone();
    }
}

impl ChoiceArgs {
    pub(super) fn apply(&self, settings: &mut EncodeSettings) {
        self.preset.apply(settings);
        let EncodeSettings { view, aggregation, cells, run, .. } = settings;
        set(&mut view.regions, &self.regions);
        set(&mut view.min_mask_px, &self.min_mask_px);
        set(&mut view.raster_width, &self.raster_width);
        set(&mut view.masks, &self.mask_levels.map(|n_levels| Masks::Auto { n_levels }));
        set(&mut run.views_limit, &self.views_limit);
        let is_limited = run.views_limit != ViewsLimit::All || run.time_budget.is_some();
        run.view_order = if is_limited { ViewOrder::Coverage } else { ViewOrder::Names };
        set(&mut run.view_order, &self.view_order);
        set(&mut aggregation.min_view_share, &self.min_view_share);
        set(&mut aggregation.truncation_power, &self.truncation_power);
        set(&mut aggregation.superpoint, &self.superpoint);
        set(&mut aggregation.coarse, &self.coarse);
        set(&mut aggregation.fill, &self.fill);
        cells.objects &= !self.no_objects && view.regions.have_masks();
        let codebook = &mut cells.shards.codebook;
        set(&mut codebook.compact_error, &self.compact_error);
        set(&mut codebook.max_components, &self.max_components);
    }
}

fn parse_raster_width(text: &str) -> Result<RasterWidth, String> {
    match text {
        "photo" => Ok(RasterWidth::Photo),
        _ => text.parse().map(RasterWidth::Px).map_err(|_| "expected photo, or a number of pixels".into()),
    }
}

fn parse_views_limit(text: &str) -> Result<ViewsLimit, String> {
    let limit = match text.strip_suffix('%') {
        Some(percent) => {
            let share = percent.parse().ok().map(|p: f64| p / 100.0);
            share.filter(|share| *share > 0.0 && *share <= 1.0).map(ViewsLimit::Share)
        }
        None => text.parse().ok().filter(|n| *n > 0).map(ViewsLimit::Count),
    };
    limit.ok_or_else(|| format!("{text:?} is neither a number of views nor a share, 1% to 100%"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_leaves_a_view_and_takes_no_more_than_there_are() {
        let of_36 =
            [ViewsLimit::All, ViewsLimit::Count(99), ViewsLimit::Share(0.25), ViewsLimit::Share(0.001)];
        assert_eq!(of_36.map(|limit| limit.of(36)), [36, 36, 9, 1]);
        assert_eq!(ViewsLimit::Count(5).of(36), 5);
    }
}
