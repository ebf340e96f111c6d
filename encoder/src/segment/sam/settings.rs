//! The settings of automatic mask generation.

/// Which of the three masks of a prompt are used.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum SamLevels {
    /// All three in one list: a duplicate goes, whatever its level, as in the reference implementation.
    #[default]
    Merged,
    /// The largest.
    Whole,
    Part,
    /// The smallest.
    Subpart,
    /// All three, each level filtered by itself, as LangSplat does.
    All,
}

impl SamLevels {
    /// Levels of each separately filtered list: 0 whole, 1 part, 2 subpart.
    pub(super) fn lists(self) -> &'static [&'static [u8]] {
        match self {
            Self::Merged => &[&[0, 1, 2]],
            Self::Whole => &[&[0]],
            Self::Part => &[&[1]],
            Self::Subpart => &[&[2]],
            Self::All => &[&[0], &[1], &[2]],
        }
    }
}

/// Thresholds of LangSplat's filter. A mask's score is its predicted IoU times its stability.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ScoreFilter {
    /// Masks need a score above this; where none has it, the best three stay.
    pub min_score: f64,
    /// A mask goes if its IoU with one of a higher score is above this.
    pub max_iou: f64,
    /// A mask of which at least 85 % lie in another one, of which it covers less than half, goes if the product of
    /// the two shares is below this.
    pub max_contained: f64,
}

impl ScoreFilter {
    pub const LANGSPLAT: Self = Self { min_score: 0.7, max_iou: 0.8, max_contained: 0.5 };
}

/// Settings for the prompts and the filters of masks. The defaults are those of the reference implementation.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SamSettings {
    pub points_per_side: u32,
    /// Points that the decoder processes at once. Memory: 0.8 MB per point, twice.
    pub points_per_batch: u32,
    /// Masks need a predicted IoU above this; 0 keeps all masks.
    pub predicted_iou: f32,
    /// Least IoU between the masks thresholded at logits of plus and minus `stability_offset`.
    pub stability: f64,
    /// Offset of the thresholds for `stability`, logits.
    pub stability_offset: f32,
    /// Of two masks in a crop with a box IoU above this, the one with the higher predicted IoU is kept.
    pub box_nms_iou: f64,
    /// The same for the pixel IoU of all masks, at the end; 1 compares none, like the reference implementation.
    pub mask_nms_iou: f64,
    /// Layers of crops in addition to the whole image; layer `i` has 4^i crops.
    pub crop_layers: u32,
    /// Of two masks in different crops with a box IoU above this, the one in the smaller crop is kept.
    pub crop_nms_iou: f64,
    /// Overlap of neighbouring crops of the first layer, relative to the shorter edge of the image.
    pub crop_overlap: f64,
    /// Divisor of the points per side from layer to layer.
    pub crop_points_divisor: u32,
    /// Which of the three masks of a prompt are used.
    pub levels: SamLevels,
    /// LangSplat's filter at the end, for each level by itself.
    pub score_filter: Option<ScoreFilter>,
    /// Holes are filled and islands removed if they have fewer pixels; 0 keeps all.
    pub min_region_px: u32,
}

impl Default for SamSettings {
    fn default() -> Self {
        Self {
            points_per_side: 32,
            points_per_batch: 64,
            predicted_iou: 0.88,
            stability: 0.95,
            stability_offset: 1.0,
            box_nms_iou: 0.7,
            mask_nms_iou: 1.0,
            crop_layers: 0,
            crop_nms_iou: 0.7,
            crop_overlap: 512.0 / 1500.0,
            crop_points_divisor: 1,
            min_region_px: 0,
            levels: SamLevels::Merged,
            score_filter: None,
        }
    }
}

impl SamSettings {
    /// The paper's: LangSplat's mask generator (Qin et al. 2024, `preprocess.py`) on a grid of 16 x 16 points, whole
    /// level only.
    pub fn paper() -> Self {
        Self {
            points_per_side: 16,
            predicted_iou: 0.7,
            stability: 0.85,
            crop_layers: 1,
            min_region_px: 100,
            levels: SamLevels::Whole,
            score_filter: Some(ScoreFilter::LANGSPLAT),
            ..Self::default()
        }
    }
}
