//! `plan` and `draw`: images of a splat, of planned views and of given ones.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow};
use clap::Args;
use glam::DVec3;
use serde_json::json;
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, View, poses};

use super::common::{self, Exit, folder_of, print};
use super::memory::default_memory_bytes;
use crate::progress::Progress;
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;
use crate::raster::{RasterView, Rasterizer, check_near_plane};
use crate::viewpoints::{self, DEFAULT_N_VIEWS, DrawnView, ViewpointSettings};
use crate::{check, ingest};

const PLAN_EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder plan --scene scene.ply --out views/\n\
    \x20 slag-encoder plan --scene scene.spz --out views/ --views-limit 96 --up 0,-1,0\n\
    \x20 slag-encoder encode --scene scene.ply --views views/transforms.json --store STORE\n";

const DRAW_EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder draw --scene scene.ply --views sparse/0 --out drawn/\n\
    \x20 slag-encoder draw --scene scene.ply --views transforms.json --out drawn/ --device cpu\n\
    \x20 slag-encoder encode --scene scene.ply --views drawn/transforms.json --store STORE\n";

/// What is drawn, and where to.
#[derive(Debug, Args)]
pub struct DrawingArgs {
    /// Splat: .ply, .spz, compressed .ply, .sog (file or folder) or .splat.
    #[arg(long, value_name = "FILE", help_heading = "Inputs")]
    pub scene: PathBuf,
    /// Folder for the images and their transforms.json.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: PathBuf,
    /// Device to draw on: auto, gpu, cpu, or numbers of adapters (`devices`).
    #[arg(long, value_name = "DEVICE", default_value_t, help_heading = "Machine")]
    pub device: DeviceChoice,
}

#[derive(Debug, Args)]
#[command(before_help = PLAN_EXAMPLES)]
pub struct PlanArgs {
    #[command(flatten)]
    pub drawing: DrawingArgs,
    /// Views to plan at most; the first ones show most.
    #[arg(long, value_name = "N", default_value_t = DEFAULT_N_VIEWS as u32, value_parser = clap::value_parser!(u32).range(1..=10_000), help_heading = "Speed and accuracy")]
    pub views_limit: u32,
    #[command(flatten)]
    pub up: UpArgs,
}

#[derive(Clone, Debug, Args)]
pub struct UpArgs {
    /// The splat's upward direction, where its Gaussians do not tell it.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_up, allow_hyphen_values = true, help_heading = "Inputs")]
    pub up: Option<DVec3>,
}

#[derive(Debug, Args)]
#[command(before_help = DRAW_EXAMPLES)]
pub struct DrawArgs {
    #[command(flatten)]
    pub drawing: DrawingArgs,
    /// Poses: the folder of a COLMAP model, a nerfstudio transforms.json, or a ScanNet scene folder (color/,
    /// pose/, intrinsic/). Lenses are drawn without their distortion.
    #[arg(long, value_name = "PATH", help_heading = "Inputs")]
    pub views: PathBuf,
    /// Writes what is drawn as arrays, too, see docs/inputs.md: the camera z of each pixel into depth/, the splat's
    /// opacity into coverage/.
    #[arg(long, help_heading = "Output")]
    pub depth: bool,
}

fn parse_up(text: &str) -> Result<DVec3, String> {
    let parts: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    let up = <[f64; 3]>::try_from(parts).ok().map(DVec3::from).filter(|_| text.split(',').count() == 3);
    up.filter(|up| up.try_normalize().is_some())
        .ok_or_else(|| "expected three numbers such as 0,0,1, not all of them 0".into())
}

impl DrawingArgs {
    /// `views`: poses to draw at.
    fn open(&self, views: Option<&Path>) -> Result<(Gaussians, Devices, String)> {
        let read = [Some(self.scene.as_path()), views].into_iter().flatten();
        let read: Vec<&Path> = read.flat_map(|path| [path, folder_of(path)]).collect();
        common::check([self.out.as_path()], &read, None)?;
        viewpoints::check_folder(&self.out)?;
        let mut scene = splat::read(&self.scene, &ReadOptions { with_sh_rest: true })?;
        ingest::drop_broken_harmonics(&mut scene);
        check::suspicions(&scene, &[]).iter().for_each(|found| tracing::warn!("{}", found.text));
        let name = self.scene.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok((scene, Devices::open(&self.device, GpuOptions::default())?, name))
    }
}

pub(super) fn plan(args: &PlanArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (mut scene, devices, name) = args.drawing.open(None)?;
    let settings = ViewpointSettings { n_views: args.views_limit as usize, up: args.up.up };
    let plan = viewpoints::plan(&scene, &devices, &settings, default_memory_bytes(), &false.into())?;
    let views = viewpoints::views_of(&plan);
    let about = json!({ "kind": plan.kind, "up": plan.up_in_world });
    viewpoints::draw_sharpened(&args.drawing.out, &views, &mut scene, &devices, &name, about, progress)?;
    let poses = args.drawing.out.join(viewpoints::POSES_FILE);
    print(json, &json!({ "plan": plan, "poses": poses }), format!("{plan}\n{}\n", poses.display()))?;
    Ok(Exit::Done)
}

pub(super) fn draw(args: &DrawArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (scene, devices, name) = args.drawing.open(Some(&args.views))?;
    let set = poses::read(&args.views, None)?;
    set.notes.iter().chain(&set.left_out()).for_each(|note| tracing::warn!("{note}"));
    let mut views: Vec<DrawnView> = set.views.iter().map(drawn_view).collect();
    let mut names = HashSet::new();
    if let Some(twice) = views.iter().find(|view| !names.insert(&view.name)) {
        return Err(anyhow!("two views would be drawn into {}; rename one of them", twice.name));
    }
    let out = &args.drawing.out;
    check_near_plane(&scene, &views.iter().map(|view| view.view).collect::<Vec<_>>())?;
    let scene = devices.load(&scene)?;
    let n_empty = viewpoints::draw(out, &mut views, scene.as_ref(), &name, args.depth, progress)?;
    let poses = out.join(viewpoints::POSES_FILE);
    let report = json!({ "n_views": views.len(), "poses": poses });
    print(json, &report, format!("{} views in {}\n", views.len(), poses.display()))?;
    if n_empty == views.len() {
        return Err(anyhow!(
            "none of the {n_empty} views shows anything of {name}; do the poses belong to it?"
        ));
    }
    if n_empty > 0 {
        tracing::warn!("{n_empty} of {} views show nothing of {name}", views.len());
        return Ok(Exit::Partly);
    }
    Ok(Exit::Done)
}

/// The file format follows from the name's extension.
fn drawn_view(view: &View) -> DrawnView {
    let intrinsics = view.intrinsics.without_distortion();
    let name = Path::new(&view.name).with_extension("png").to_string_lossy().into_owned();
    DrawnView { name, view: RasterView { intrinsics, ..RasterView::of(view) }, about: json!({}) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn up_is_three_numbers() {
        assert_eq!(parse_up("0,-1,0.5"), Ok(DVec3::new(0.0, -1.0, 0.5)));
        for wrong in ["", "1,2", "1,2,3,4", "1,2,z", "0,0,0", "NaN,0,0", "1,2,3,"] {
            assert!(parse_up(wrong).is_err(), "{wrong}");
        }
    }
}
