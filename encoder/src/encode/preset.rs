//! Presets: bundles of choices with a name.

use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use super::settings::{DEFAULT_MASK_LEVELS, RasterWidth, Regions, ViewsLimit};
use crate::codebook::CodebookSettings;
use crate::embed::Background;
use crate::lift::Aggregation;
use crate::raster::WeightKind;
use crate::segment::SamSettings;

/// A bundle of choices. `slag-lab bench tradeoff` measures the cost and quality of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper's own settings: SAM on a grid of 16 x 16 points with LangSplat's filters, whole masks alone, uncleaned;
    /// white behind the masks, rasters 648 pixels wide, the plain average, no objects. Without `--segmenter` the
    /// built-in segmenter stands in for SAM, with its coarsest masks.
    Paper,
    /// The paper's method with the masks of `balanced`: rasters as wide as photos, the plain average, no objects.
    Plain,
    /// Half of the views, by coverage; two scales of masks, by their crops alone; coarse rasters; refined contributions.
    Fast,
    /// All views; refined contributions.
    Balanced,
}

/// The choices of a preset.
#[derive(Clone, Debug)]
pub struct Choices {
    /// What fills a crop outside its mask.
    pub background: Background,
    /// What of a photo has vectors.
    pub regions: Regions,
    /// Which weight is summed.
    pub weights: WeightKind,
    /// How contributions become embeddings.
    pub aggregation: Aggregation,
    /// Whether masks that views agree on become objects.
    pub objects: bool,
    /// Number of scales at which the built-in segmenter looks.
    pub mask_levels: usize,
    /// Masks with fewer pixels are left out.
    pub min_mask_px: u32,
    /// Whether slivers between masks join their neighbours.
    pub merges_slivers: bool,
    /// How Segment Anything finds masks, where it does.
    pub sam: SamSettings,
    /// Views used at most.
    pub views_limit: ViewsLimit,
    /// Width at which weights are rasterised.
    pub raster_width: RasterWidth,
    /// Errors that the profiles may have.
    pub codebook: CodebookSettings,
}

impl Preset {
    /// Parses a preset's name; a preset that is gone is refused with its replacement.
    pub fn parser() -> impl TypedValueParser<Value = Self> {
        const REMOVED: &str = "accurate";
        let names = Self::value_variants().iter().filter_map(ValueEnum::to_possible_value);
        PossibleValuesParser::new(names.chain([PossibleValue::new(REMOVED).hide(true)])).try_map(|name| match &*name {
            REMOVED => Err("it was no more accurate than balanced on unseen scenes (docs/accuracy.md) and is gone; its rasters are --raster-width twice".into()),
            name => Self::from_str(name, false),
        })
    }

    /// Returns the choices of the preset.
    pub fn choices(self) -> Choices {
        let balanced = Choices {
            background: Background::White,
            regions: Regions::Masks,
            weights: WeightKind::Blend,
            aggregation: Aggregation::REFINED,
            objects: true,
            mask_levels: DEFAULT_MASK_LEVELS,
            min_mask_px: 200,
            merges_slivers: true,
            sam: SamSettings::default(),
            views_limit: ViewsLimit::All,
            raster_width: RasterWidth::Photo,
            codebook: CodebookSettings::default(),
        };
        match self {
            Self::Balanced => balanced,
            Self::Plain => Choices {
                regions: Regions::Crops,
                aggregation: Aggregation::PLAIN,
                objects: false,
                ..balanced
            },
            // Section "Settings" of the paper (IEEE RA-L 2025): grid 16, whole level, ScanNet's raster of 648 x 484.
            Self::Paper => Choices {
                regions: Regions::Crops,
                aggregation: Aggregation::PLAIN,
                objects: false,
                mask_levels: 1,
                min_mask_px: 1,
                merges_slivers: false,
                raster_width: RasterWidth::Px(648),
                sam: SamSettings::paper(),
                ..balanced
            },
            Self::Fast => Choices {
                regions: Regions::Crops,
                mask_levels: 2,
                views_limit: ViewsLimit::Share(0.5),
                raster_width: RasterWidth::Px(320),
                ..balanced
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::encode::{EncodeSettings, Masks};
    use crate::segment::{SamLevels, ScoreFilter};

    /// The program without flags and the library with default settings do the same.
    #[test]
    fn balanced_is_what_the_library_has_as_its_own() {
        let library = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        let balanced = Preset::Balanced.choices();
        assert_eq!(balanced.aggregation, library.aggregation);
        assert_eq!(balanced.objects, library.cells.objects);
        assert_eq!(balanced.views_limit, library.run.views_limit);
        assert_eq!(balanced.raster_width, library.view.raster_width);
        assert_eq!(balanced.min_mask_px, library.view.min_mask_px);
        assert_eq!(balanced.background, library.view.background);
        assert_eq!(balanced.regions, library.view.regions);
        assert_eq!(balanced.weights, library.view.weights);
        assert_eq!(balanced.codebook, library.cells.shards.codebook);
        let levels = balanced.mask_levels;
        assert_eq!(balanced.merges_slivers, library.view.merges_slivers);
        assert_eq!(library.view.masks, Masks::Auto { n_levels: levels });
    }

    /// The others differ in what their descriptions say.
    #[test]
    fn presets_are_what_they_are_called() {
        let [plain, fast, balanced] = [Preset::Plain, Preset::Fast, Preset::Balanced].map(Preset::choices);
        // The same masks, so that only what is made of them differs.
        assert_eq!((plain.aggregation, plain.objects), (Aggregation::default(), false));
        assert_eq!((plain.mask_levels, plain.views_limit), (balanced.mask_levels, ViewsLimit::All));
        assert_eq!(fast.views_limit.of(96), 48);
        assert_eq!((fast.mask_levels, fast.raster_width), (2, RasterWidth::Px(320)));
        assert_eq!(fast.aggregation, balanced.aggregation);
    }

    /// Oracle: the paper's text and LangSplat's `preprocess.py`, copied by hand.
    #[test]
    fn paper_has_the_papers_settings() {
        let Choices {
            background,
            regions,
            weights,
            aggregation,
            objects,
            min_mask_px,
            merges_slivers,
            raster_width,
            sam,
            ..
        } = Preset::Paper.choices();
        assert_eq!(
            (background, regions, weights, aggregation),
            (Background::White, Regions::Crops, WeightKind::Blend, Aggregation::default())
        );
        assert_eq!(
            (objects, min_mask_px, merges_slivers, raster_width),
            (false, 1, false, RasterWidth::Px(648))
        );
        assert_eq!((sam.points_per_side, sam.levels), (16, SamLevels::Whole));
        assert_eq!((sam.predicted_iou, sam.stability, sam.stability_offset), (0.7, 0.85, 1.0));
        assert_eq!((sam.crop_layers, sam.crop_points_divisor, sam.min_region_px), (1, 1, 100));
        assert_eq!((sam.box_nms_iou, sam.crop_nms_iou, sam.mask_nms_iou), (0.7, 0.7, 1.0));
        let langsplat = ScoreFilter { min_score: 0.7, max_iou: 0.8, max_contained: 0.5 };
        assert_eq!(sam.score_filter, Some(langsplat));
    }
}
