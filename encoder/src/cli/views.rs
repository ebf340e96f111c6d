//! The flags that choose views and the number of their masks.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use crate::encode::{RasterWidth, ViewOrder, ViewsLimit};

/// The order of views and the time for them. Contributions are kept until all views are used, so an encode with a
/// higher limit or more time continues from there.
#[derive(Clone, Debug, Args)]
pub struct ViewsArgs {
    /// Order in which views are taken [default: coverage with a limit or a budget, else names].
    #[arg(long, value_enum, value_name = "ORDER")]
    view_order: Option<ViewOrder>,
    /// Seconds after which no further view is begun; the finished views are published.
    #[arg(long, value_name = "SECS", value_parser = parse_secs)]
    pub time_budget: Option<Duration>,
    /// Number of scales at which the built-in segmenter looks, coarsest first [default: the preset's].
    #[arg(long, value_name = "N", value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=4))]
    pub mask_levels: Option<usize>,
    /// Poses of further photos in the same world, in one file of poses or several: the scene is encoded from these and
    /// those of --views, and only views that the store does not keep are segmented, embedded and rasterised. Keeps the
    /// contributions of views, as --keep-views does.
    #[arg(long = "add", value_name = "POSES")]
    pub added: Vec<PathBuf>,
    /// Leaves out a view, by its name in the poses file; nothing else is segmented, embedded and rasterised again. Keeps
    /// the contributions of views, as --keep-views does.
    #[arg(long = "drop", value_name = "VIEW")]
    pub dropped: Vec<String>,
}

impl ViewsArgs {
    /// Returns whether photos are added to those of the poses file or left out.
    pub(super) fn changes_photos(&self) -> bool {
        !self.added.is_empty() || !self.dropped.is_empty()
    }

    /// Returns the order of the flags.
    pub(super) fn order(&self, views_limit: ViewsLimit) -> ViewOrder {
        let default = match views_limit != ViewsLimit::All || self.time_budget.is_some() {
            true => ViewOrder::Coverage,
            false => ViewOrder::Names,
        };
        self.view_order.unwrap_or(default)
    }
}

/// Parses the width of rasters.
pub(super) fn parse_raster_width(text: &str) -> Result<RasterWidth, String> {
    match text {
        "auto" => Err("it was no more accurate than `photo` (docs/accuracy.md) and is gone".into()),
        "photo" => Ok(RasterWidth::Photo),
        "twice" => Ok(RasterWidth::Twice),
        _ => {
            let width_px = text.parse().ok().filter(|px| (16..=8192).contains(px));
            width_px
                .map(RasterWidth::Px)
                .ok_or_else(|| format!("{text:?} is none of: photo, twice, 16 to 8192 pixels"))
        }
    }
}

/// Parses a number of views, or a share of them in per cent.
pub(super) fn parse_views_limit(text: &str) -> Result<ViewsLimit, String> {
    let limit = match text.strip_suffix('%') {
        Some(percent) => percent.parse().ok().map(|p: f64| ViewsLimit::Share(p / 100.0)),
        None => text.parse().ok().map(ViewsLimit::Count),
    };
    let is_some = |limit: &ViewsLimit| match limit {
        ViewsLimit::All => true,
        ViewsLimit::Count(n) => *n > 0,
        ViewsLimit::Share(share) => *share > 0.0 && *share <= 1.0,
    };
    limit
        .filter(is_some)
        .ok_or_else(|| format!("{text:?} is neither a number of views nor a share, 1% to 100%"))
}

fn parse_secs(text: &str) -> Result<Duration, String> {
    let secs = text.parse().ok().filter(|secs: &f64| *secs > 0.0);
    secs.and_then(|secs| Duration::try_from_secs_f64(secs).ok())
        .ok_or_else(|| "expected seconds above 0".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_and_widths_are_numbers_or_words() {
        assert_eq!(parse_views_limit("7"), Ok(ViewsLimit::Count(7)));
        assert_eq!(parse_views_limit("12.5%"), Ok(ViewsLimit::Share(0.125)));
        assert!(parse_raster_width("auto").expect_err("gone").contains("`photo`"));
        assert_eq!(parse_raster_width("photo"), Ok(RasterWidth::Photo));
        assert_eq!(parse_raster_width("16"), Ok(RasterWidth::Px(16)));
        assert!(parse_raster_width("8193").is_err() && parse_views_limit("-1").is_err());
    }

    #[test]
    fn a_limit_leaves_a_view_and_takes_no_more_than_there_are() {
        let of_36 =
            [ViewsLimit::All, ViewsLimit::Count(99), ViewsLimit::Share(0.25), ViewsLimit::Share(0.001)];
        assert_eq!(of_36.map(|limit| limit.of(36)), [36, 36, 9, 1]);
        assert_eq!(ViewsLimit::Count(5).of(36), 5);
    }
}
