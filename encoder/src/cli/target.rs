//! `encode --target-seconds S --target-bytes B`: the setting is picked from a measured front.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::ByteSize;

use crate::encode::front::{Expectation, Front, Target};
use crate::encode::{InputSettings, count_inputs};

/// Flags that a front sets, by their names in the program, so a user cannot give them beside a target.
pub(super) const TUNED: [&str; 13] = [
    "preset",
    "background",
    "weights",
    "views_limit",
    "view_order",
    "mask_levels",
    "raster_width",
    "min_mask_px",
    "keep_slivers",
    "compact_error",
    "max_components",
    "no_objects",
    "segmenter",
];
/// Flags of the refinements, which a front may set as well.
pub(super) const REFINEMENTS: [&str; 11] = [
    "min_region_share",
    "min_view_share",
    "min_weight",
    "truncation_power",
    "equalisation",
    "agreement",
    "median_steps",
    "superpoint",
    "coarse",
    "object",
    "fill",
];

/// A target instead of a preset.
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Target")]
pub struct TargetArgs {
    /// Picks the most accurate measured setting that is expected to take at most this many seconds. The expectation
    /// holds for the machine, models and size of photos that the front was measured with.
    #[arg(long, value_name = "S", value_parser = parse_seconds, requires = "front", conflicts_with_all = TUNED, conflicts_with_all = REFINEMENTS)]
    target_seconds: Option<f64>,
    /// Picks the most accurate measured setting whose compact shards are expected to have at most this many bytes.
    #[arg(long, value_name = "BYTES", requires = "front", conflicts_with_all = TUNED, conflicts_with_all = REFINEMENTS)]
    target_bytes: Option<ByteSize>,
    /// Front to pick from: front.json, as `slag-lab bench tradeoff` writes it for your machine and scenes.
    #[arg(long, value_name = "FILE")]
    front: Option<PathBuf>,
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|s: &f64| *s > 0.0 && s.is_finite())
        .ok_or_else(|| "expected seconds above 0".into())
}

impl TargetArgs {
    /// Returns the setting that meets the target on the inputs; `None` without a target.
    pub(super) fn choose(&self, inputs: &InputSettings) -> Result<Option<Expectation>> {
        let target = Target { seconds: self.target_seconds, bytes: self.target_bytes.map(|bytes| bytes.0) };
        let Some(path) = &self.front else { return Ok(None) };
        if target == Target::default() {
            return Err(anyhow!("--front needs --target-seconds or --target-bytes"));
        }
        let front = Front::read(path)?;
        let (n_photos, n_gaussians) = count_inputs(inputs)?;
        let chosen = front.choose(target, n_photos, n_gaussians)?;
        let bytes = ByteSize(chosen.bytes as u64);
        tracing::info!(
            "setting {:?} ({}): {:.1} s and {bytes} of {} shards are expected for {n_photos} photos and {n_gaussians} \
             Gaussians, measured on {} scenes on {} with {}; mIoU there {:.3} (standard deviation {:.3})",
            chosen.setting.name,
            chosen.setting.flags,
            chosen.seconds,
            chosen.setting.profile,
            front.n_scenes,
            front.machine,
            front.measured_with,
            chosen.setting.miou,
            chosen.setting.miou_spread,
        );
        Ok(Some(chosen))
    }
}
