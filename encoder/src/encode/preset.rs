//! Presets: bundles of choices with a name.

use clap::ValueEnum;

use super::settings::{EncodeSettings, Masks, RasterWidth, Regions, ViewsLimit};
use crate::lift::Aggregation;
use crate::segment::SamSettings;

/// A bundle of choices. `slag-lab bench tradeoff` measures the cost and quality of each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper's own settings: SAM on a grid of 16 x 16 points with LangSplat's filters, whole masks alone,
    /// uncleaned; white behind the masks, rasters 648 pixels wide, the plain average, no objects. Without
    /// `--segmenter` the built-in segmenter stands in for SAM, with its coarsest masks.
    Paper,
    /// The paper's method with the masks of `balanced`: rasters as wide as photos, the plain average, no objects.
    Plain,
    /// Half of the views, by coverage; two scales of masks, by their crops alone; coarse rasters; refined
    /// contributions.
    Fast,
    /// All views; refined contributions.
    #[default]
    Balanced,
}

impl Preset {
    /// Applies the preset to default settings, which are those of [`Self::Balanced`].
    pub fn apply(self, settings: &mut EncodeSettings) {
        let EncodeSettings { view, aggregation, cells, run, .. } = settings;
        match self {
            Self::Balanced => {}
            Self::Plain => {
                view.regions = Regions::Crops;
                *aggregation = Aggregation::PLAIN;
                cells.objects = false;
            }
            // Section "Settings" of the paper (IEEE RA-L 2025): grid 16, whole level, ScanNet's raster of 648 x 484.
            Self::Paper => {
                view.masks = Masks::Auto { n_levels: 1 };
                view.regions = Regions::Crops;
                view.min_mask_px = 1;
                view.merges_slivers = false;
                view.raster_width = RasterWidth::Px(648);
                *aggregation = Aggregation::PLAIN;
                cells.objects = false;
            }
            Self::Fast => {
                view.masks = Masks::Auto { n_levels: 2 };
                view.regions = Regions::Crops;
                view.raster_width = RasterWidth::Px(320);
                run.views_limit = ViewsLimit::Share(0.5);
            }
        }
    }

    /// Settings of Segment Anything, for encodes that use it.
    pub fn sam(self) -> SamSettings {
        match self {
            Self::Paper => SamSettings::paper(),
            _ => SamSettings::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::segment::{SamLevels, ScoreFilter};

    fn settings(preset: Preset) -> EncodeSettings {
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        preset.apply(&mut settings);
        settings
    }

    /// Oracle: the paper's text and LangSplat's `preprocess.py`, copied by hand.
    #[test]
    fn paper_has_the_papers_settings() {
        let paper = settings(Preset::Paper);
        let view = &paper.view;
        assert_eq!((view.regions, paper.aggregation), (Regions::Crops, Aggregation::default()));
        assert_eq!(
            (paper.cells.objects, view.min_mask_px, view.merges_slivers, view.raster_width),
            (false, 1, false, RasterWidth::Px(648))
        );
        let sam = Preset::Paper.sam();
        assert_eq!((sam.points_per_side, sam.levels), (16, SamLevels::Whole));
        assert_eq!((sam.predicted_iou, sam.stability, sam.stability_offset), (0.7, 0.85, 1.0));
        assert_eq!((sam.crop_layers, sam.crop_points_divisor, sam.min_region_px), (1, 1, 100));
        assert_eq!((sam.box_nms_iou, sam.crop_nms_iou, sam.mask_nms_iou), (0.7, 0.7, 1.0));
        let langsplat = ScoreFilter { min_score: 0.7, max_iou: 0.8, max_contained: 0.5 };
        assert_eq!(sam.score_filter, Some(langsplat));
    }
}
