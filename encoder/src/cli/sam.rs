//! The flags of Segment Anything.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use slag_models::commands;

use super::common::available_threads;
use crate::encode::Masks;
use crate::segment::{SamLevels, SamSettings};

/// Masks from Segment Anything; the other flags need `--segmenter`.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Segment Anything")]
pub(crate) struct SamArgs {
    /// SAM, SAM 2, MobileSAM, EdgeTAM or another model of that kind: a folder with model.toml, or the name of a
    /// pulled model (`models list`).
    #[arg(long, value_name = "NAME|DIR", help_heading = "Models")]
    segmenter: Option<PathBuf>,
    /// Points along each side of the grid of prompts: 8, 16, 32, 64 [default: the preset's].
    #[arg(long, value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=256), help_heading = "Speed and accuracy", hide_short_help = true)]
    points_per_side: Option<u32>,
    /// Points per run of the model: more are faster on GPUs and take more memory.
    #[arg(long, value_name = "N", default_value_t = SamSettings::default().points_per_batch,
        value_parser = clap::value_parser!(u32).range(1..=1024), hide_short_help = true)]
    sam_points_per_batch: u32,
    /// Least IoU that the model predicts for a mask, 0 to 1 [default: the preset's].
    #[arg(long, value_name = "IOU", value_parser = parse_f32_ratio, hide_short_help = true)]
    sam_predicted_iou: Option<f32>,
    /// Least IoU of a mask with itself under a higher and a lower threshold, 0 to 1 [default: the preset's].
    #[arg(long, value_name = "IOU", value_parser = parse_ratio, hide_short_help = true)]
    sam_stability: Option<f64>,
    /// Distance of those thresholds from 0, logits.
    #[arg(long, value_name = "LOGITS", default_value_t = SamSettings::default().stability_offset, value_parser = parse_offset, hide_short_help = true)]
    sam_stability_offset: f32,
    /// IoU of boxes from which two masks are the same.
    #[arg(long, value_name = "IOU", default_value_t = SamSettings::default().box_nms_iou, value_parser = parse_ratio, hide_short_help = true)]
    sam_box_nms: f64,
    /// IoU of pixels from which two masks are the same; 1 compares boxes only.
    #[arg(long, value_name = "IOU", default_value_t = SamSettings::default().mask_nms_iou, value_parser = parse_ratio, hide_short_help = true)]
    sam_mask_nms: f64,
    /// Layers of crops, to find small things: layer i segments 4^i crops besides the whole image [default: the
    /// preset's].
    #[arg(long, value_name = "N",
        value_parser = clap::value_parser!(u32).range(0..=4), hide_short_help = true)]
    sam_crop_layers: Option<u32>,
    /// IoU of boxes from which masks of two crops are the same.
    #[arg(long, value_name = "IOU", default_value_t = SamSettings::default().crop_nms_iou, value_parser = parse_ratio, hide_short_help = true)]
    sam_crop_nms: f64,
    /// Fills holes and drops islands of masks with fewer pixels [default: the preset's].
    #[arg(long, value_name = "PX", hide_short_help = true)]
    sam_min_region_px: Option<u32>,
    /// Which of the three masks of each prompt are used [default: the preset's].
    #[arg(long, value_enum, hide_short_help = true)]
    sam_levels: Option<SamLevels>,
    /// Threads within the model; masks may depend on their number in the last bits [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024), hide_short_help = true)]
    sam_threads: Option<u32>,
}

impl SamArgs {
    /// Returns Segment Anything as the source of masks, if --segmenter names it.
    pub(super) fn masks(&self, preset: &SamSettings) -> Result<Option<Masks>> {
        let Some(segmenter) = &self.segmenter else { return Ok(None) };
        let dir = commands::resolve(segmenter, &|name| std::env::var_os(name))?;
        let settings = SamSettings {
            points_per_side: self.points_per_side.unwrap_or(preset.points_per_side),
            points_per_batch: self.sam_points_per_batch,
            predicted_iou: self.sam_predicted_iou.unwrap_or(preset.predicted_iou),
            stability: self.sam_stability.unwrap_or(preset.stability),
            stability_offset: self.sam_stability_offset,
            box_nms_iou: self.sam_box_nms,
            mask_nms_iou: self.sam_mask_nms,
            crop_layers: self.sam_crop_layers.unwrap_or(preset.crop_layers),
            crop_nms_iou: self.sam_crop_nms,
            min_region_px: self.sam_min_region_px.unwrap_or(preset.min_region_px),
            levels: self.sam_levels.unwrap_or(preset.levels),
            ..*preset
        };
        let n_model_threads = self.sam_threads.map_or_else(available_threads, |n| n as usize);
        Ok(Some(Masks::Sam { dir, settings, n_model_threads }))
    }
}

fn parse_ratio(text: &str) -> Result<f64, String> {
    let ratio: f64 = text.parse().map_err(|error| format!("{error}"))?;
    (0.0..=1.0).contains(&ratio).then_some(ratio).ok_or_else(|| "expected 0 to 1".into())
}

fn parse_f32_ratio(text: &str) -> Result<f32, String> {
    parse_ratio(text).map(|ratio| ratio as f32)
}

fn parse_offset(text: &str) -> Result<f32, String> {
    let offset: f32 = text.parse().map_err(|error| format!("{error}"))?;
    (0.0..=100.0).contains(&offset).then_some(offset).ok_or_else(|| "expected 0 to 100".into())
}
