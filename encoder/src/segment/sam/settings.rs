//! The settings of automatic mask generation.

/// Settings for the prompts and the filters of masks. The defaults are those of the reference implementation.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SamSettings {
    /// Points along each side of the grid.
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
        }
    }
}
