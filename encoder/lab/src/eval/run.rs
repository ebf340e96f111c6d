//! Encodes a scene with settings, in this process, and opens what it published.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use slag_encoder::cli::common::{ModelArgs, cancel_flag, open_models};
use slag_encoder::encode::{
    self, DEFAULT_MASK_LEVELS, EncodeSettings, EncodeSummary, Engines, Masks, Restart,
};
use slag_encoder::progress::Silent;
use slag_encoder::raster::devices::{DeviceChoice, Devices};
use slag_encoder::raster::gpu::GpuOptions;
use slag_encoder::store::StoreReader;
use slag_models::{ModelDir, SessionOptions, TextEncoder};

use super::truth::Truth;
use crate::scenes::SceneFiles;

/// Scenes to encode, with what, and where to.
#[derive(Debug, Args)]
pub(crate) struct ScenesArgs {
    /// Scenes: a splat, transforms.json, photos and gt/, as `generate scene` writes them.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    pub(crate) scene: Vec<PathBuf>,
    #[command(flatten)]
    pub(crate) models: ModelArgs,
    /// Device that rasterises: auto (GPUs, else the CPU), gpu, cpu, or numbers of adapters.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub(crate) device: DeviceChoice,
    /// Folder for the stores; a later run reuses the views there.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum MaskSource {
    Given,
    /// The built-in segmenter.
    Automatic,
}

impl MaskSource {
    pub(crate) const ALL: [Self; 2] = [Self::Given, Self::Automatic];

    pub(crate) fn name(self) -> &'static str {
        if self == Self::Given { "given" } else { "automatic" }
    }

    /// `None` for a scene without labels.
    fn masks(self, files: &SceneFiles) -> Option<Masks> {
        match self {
            Self::Given => files.true_masks.clone().map(|dir| Masks::Given { dir, ignore_ids: Vec::new() }),
            Self::Automatic => Some(Masks::Auto { n_levels: DEFAULT_MASK_LEVELS }),
        }
    }
}

pub(crate) struct Runner {
    models: ModelDir,
    session: SessionOptions,
    devices: Devices,
    cancel: std::sync::Arc<AtomicBool>,
    out: PathBuf,
}

pub(crate) struct Encoded {
    pub(crate) reader: StoreReader,
    pub(crate) summary: EncodeSummary,
    /// Seconds of the encode; few if the store had its views already.
    pub(crate) secs: f64,
}

impl Runner {
    pub(crate) fn open(args: &ScenesArgs) -> Result<Self> {
        let (models, session) = open_models(&args.models)?;
        let devices = Devices::open(&args.device, GpuOptions::default())?;
        Ok(Self { models, session, devices, cancel: cancel_flag()?, out: args.out.clone() })
    }

    pub(crate) fn encoder_id(&self) -> String {
        self.models.encoder_id().to_string()
    }

    pub(crate) fn text_encoder(&self) -> Result<Box<dyn TextEncoder>> {
        Ok(self.models.text_encoder(&self.session)?)
    }

    /// Encodes a scene with masks of a source as `change` says; `method` names the store. `None` without such masks.
    pub(crate) fn encode(
        &self,
        files: &SceneFiles,
        source: MaskSource,
        method: &str,
        change: impl FnOnce(&mut EncodeSettings),
    ) -> Result<Option<Encoded>> {
        let Some(masks) = source.masks(files) else { return Ok(None) };
        let store = self.out.join(&files.name).join(source.name()).join(method);
        fs_err::create_dir_all(&store)?;
        let mut settings = EncodeSettings::new(files.splat.clone(), files.poses.clone(), store.clone(), true);
        settings.inputs.images = files.images.clone();
        settings.output.scene_name = files.name.clone();
        settings.view.masks = masks;
        settings.run.strict = true;
        settings.run.restart = Restart::IfOther;
        settings.run.keep_views = true;
        change(&mut settings);
        let start = Instant::now();
        let engines = Engines::new(&self.models, &self.session, &self.devices);
        let summary = encode::encode(&settings, &engines, &Silent, &self.cancel)?;
        let secs = start.elapsed().as_secs_f64();
        Ok(Some(Encoded { reader: StoreReader::open(&store)?, summary, secs }))
    }
}

pub(crate) fn truth_of(reader: &StoreReader, dir: &Path) -> Result<Truth> {
    let manifest = reader.manifest();
    Truth::read(dir, (manifest.n_gaussians + manifest.n_rejected) as usize)
}
