//! `check`: compares renderings of the scene with the photos.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::{poses, splat};

use super::common::{InputArgs, print};
use super::exit::Exit;
use crate::check::{self, CheckOptions, CheckView};
use crate::ingest;
use crate::raster::RasterView;
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;

/// `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Scene, poses, photos.
    #[command(flatten)]
    pub input: InputArgs,
    /// Views to render, evenly spread.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub samples: u32,
    /// Device to render on: auto, gpu, cpu, or the number of an adapter (`devices`).
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Width to render at, pixels.
    #[arg(long, value_name = "PX", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub raster_width: u32,
    /// Folder for PNGs of each photo beside its rendering.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

pub(super) fn run(args: &CheckArgs, json: bool) -> Result<Exit> {
    let scene = splat::read(&args.input.scene, &splat::ReadOptions { with_sh_rest: true })?;
    let all = poses::read(&args.input.views, args.input.images.as_deref())?.views;
    let missing: Vec<_> = ingest::missing_images(&all).into_iter().map(|v| v.image_path.clone()).collect();
    if let Some(first) = missing.first() {
        let message = format!(
            "{} of {} photos are missing, the first is {}",
            missing.len(),
            all.len(),
            first.display()
        );
        if args.input.strict || missing.len() == all.len() {
            return Err(anyhow!("{message}; give their folder with --images"));
        }
        tracing::warn!("{message}");
    }
    let there: Vec<_> = all.into_iter().filter(|v| !missing.contains(&v.image_path)).collect();
    let n = (args.samples as usize).min(there.len());
    // One at a time: a photo is loaded when the check reaches it.
    let views = (0..n).map(|i| {
        let loaded = ingest::load_image(&there[i * there.len() / n])?;
        let view = RasterView {
            camera_from_world: loaded.view.camera_from_world,
            intrinsics: loaded.view.intrinsics,
        };
        Ok(CheckView { name: loaded.view.name, image: loaded.image, view })
    });
    let options = CheckOptions {
        width_px: args.raster_width,
        pictures_dir: args.out.clone(),
        ..CheckOptions::default()
    };
    let report = check::check(&scene, views, &Devices::open(args.device, GpuOptions::default())?, &options)?;
    print(json, &report, &report)?;
    Ok(if missing.is_empty() { Exit::Done } else { Exit::Partly })
}
