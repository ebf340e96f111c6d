//! Flags that comparisons on labelled scenes share.

use std::path::PathBuf;

use clap::Args;

use slag_encoder::cli::common::ModelArgs;
use slag_encoder::encode::EncodeSettings;
use slag_encoder::raster::devices::DeviceChoice;

/// What is compared on, with what, and where to.
#[derive(Debug, Args)]
pub struct ComparisonArgs {
    /// Labelled scenes: a splat, transforms.json, photos and gt/, as `generate scene` writes them.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    pub scene: Vec<PathBuf>,
    /// Models.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Device that rasterises: auto (GPUs, else the CPU), gpu, cpu, or numbers of adapters.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Folder for the stores; a later run reuses the views there.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Settings of a comparison's encodes; each sets its own inputs and store.
pub(super) fn encode_settings(name: &str) -> EncodeSettings {
    let mut encode = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
    encode.output.scene_name = name.into();
    encode.run.strict = true;
    encode.run.restart = true;
    encode
}
