//! `encode --preset`: bundles of choices, of which flags change single ones.

use clap::ValueEnum;

use crate::codebook::CodebookSettings;
use crate::embed::Background;
use crate::encode::{DEFAULT_MASK_LEVELS, RasterWidth, ViewsLimit};
use crate::lift::Aggregation;
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
    pub codebook: CodebookSettings,
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
            codebook: CodebookSettings::default(),
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
                codebook: CodebookSettings { compact_error: 0.05, balanced_error: 0.01, ..balanced.codebook },
                ..balanced
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::encode::EncodeSettings;

    /// The program without flags does what the library does without settings.
    #[test]
    fn balanced_is_what_the_library_has_as_its_own() {
        let library = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        let balanced = Preset::Balanced.choices();
        assert_eq!(balanced.aggregation, library.aggregation);
        assert_eq!(balanced.objects, library.objects);
        assert_eq!(balanced.views_limit, library.views_limit);
        assert_eq!(balanced.raster_width, library.raster_width);
        assert_eq!(balanced.min_mask_px, library.min_mask_px);
        assert_eq!(balanced.background, library.background);
        assert_eq!(balanced.weights, library.weights);
        assert_eq!(balanced.codebook, library.shards.codebook);
        let levels = balanced.mask_levels;
        assert_eq!(library.masks, crate::encode::Masks::Auto { n_levels: levels });
    }

    /// The others differ in what their descriptions say.
    #[test]
    fn presets_are_what_they_are_called() {
        let [paper, fast, balanced, accurate] =
            [Preset::Paper, Preset::Fast, Preset::Balanced, Preset::Accurate].map(Preset::choices);
        // The same masks, so that only what is made of them differs.
        assert_eq!((paper.aggregation, paper.objects), (Aggregation::default(), false));
        assert_eq!((paper.mask_levels, paper.views_limit), (balanced.mask_levels, ViewsLimit::All));
        assert_eq!(fast.views_limit.of(96), 48);
        assert_eq!((fast.mask_levels, fast.raster_width), (2, RasterWidth::Px(320)));
        assert_eq!(fast.aggregation, balanced.aggregation);
        assert_eq!(accurate.aggregation, balanced.aggregation);
        assert_eq!(accurate.codebook.compact_error, 0.5 * balanced.codebook.compact_error);
        assert_eq!(accurate.codebook.balanced_error, 0.5 * balanced.codebook.balanced_error);
    }
}
