//! `encode --preset`: bundles of choices, of which flags change single ones.

use clap::ValueEnum;

use crate::embed::Background;
use crate::encode::{DEFAULT_MASK_LEVELS, RasterWidth, ViewsLimit};
use crate::lift::Aggregation;
use crate::palette::PaletteSettings;
use crate::raster::WeightKind;

/// Bundles of choices. What each costs and gives is in README.md, measured by `bench tradeoff`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper's method: white behind the masks, rasters as wide as photos, the plain average, no objects.
    Paper,
    /// Half of the views, by coverage, two scales of masks, coarse rasters; refined.
    Fast,
    /// All views; refined.
    Balanced,
    /// As balanced, with half the errors of scores in the shards.
    Accurate,
}

/// What a preset stands for.
#[derive(Clone, Copy, Debug)]
pub struct Choices {
    /// What fills a crop outside its mask.
    pub background: Background,
    /// Which weight is summed.
    pub weights: WeightKind,
    /// How sums become embeddings.
    pub aggregation: Aggregation,
    /// Whether there are objects.
    pub objects: bool,
    /// Scales at which the built-in segmenter looks.
    pub mask_levels: usize,
    /// Masks with fewer pixels are left out.
    pub min_mask_px: u32,
    /// Views to use at most.
    pub views_limit: ViewsLimit,
    /// Width at which weights are rasterised.
    pub raster_width: RasterWidth,
    /// Errors of the profiles.
    pub palette: PaletteSettings,
}

impl Preset {
    /// Returns what the preset stands for.
    pub fn choices(self) -> Choices {
        let balanced = Choices {
            background: Background::White,
            weights: WeightKind::Blend,
            aggregation: Aggregation::REFINED,
            objects: true,
            mask_levels: DEFAULT_MASK_LEVELS,
            min_mask_px: 200,
            views_limit: ViewsLimit::All,
            raster_width: RasterWidth::ByContent,
            palette: PaletteSettings::default(),
        };
        match self {
            Self::Balanced => balanced,
            Self::Paper => Choices {
                aggregation: Aggregation::PAPER,
                objects: false,
                raster_width: RasterWidth::Photo,
                ..balanced
            },
            Self::Fast => Choices {
                mask_levels: 2,
                views_limit: ViewsLimit::Share(0.5),
                raster_width: RasterWidth::Px(320),
                ..balanced
            },
            Self::Accurate => Choices {
                palette: PaletteSettings { compact_error: 0.05, balanced_error: 0.01, ..balanced.palette },
                ..balanced
            },
        }
    }
}
