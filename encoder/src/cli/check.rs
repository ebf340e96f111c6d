//! `check`: compares renderings of the scene with the photos.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use clap::Args;
use slag_common::poses::SplatFrame;
use slag_common::{View, durable, files, poses, splat};

use super::common::{Exit, InputArgs, print};
use super::memory::free_memory_bytes;
use super::{common, next};
use crate::check::{self, Alignment, CheckOptions, CheckReport, CheckView, FrameCandidate, FrameCause};
use crate::ingest::{self, FoundFrame, IngestError, OddPhotos};
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;
use crate::raster::{RasterView, check_near_plane};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder check --scene splat.ply --views sparse/0 --out look/\n\
    \x20 slag-encoder check --scene splat.ply --views sparse/0 --images photos/ --samples 30\n\
    \x20 slag-encoder check --scene splat.ply --views transforms.json --write-frame frame.json\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct CheckArgs {
    /// Scene, poses, photos.
    #[command(flatten)]
    pub input: InputArgs,
    /// Views to render, evenly spread.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..), help_heading = "Speed and accuracy")]
    pub samples: u32,
    /// Device to render on: auto, gpu, cpu, or numbers of adapters (`devices`).
    #[arg(long, value_name = "DEVICE", default_value_t, help_heading = "Machine")]
    pub device: DeviceChoice,
    /// Width to render at, pixels.
    #[arg(long, value_name = "PX", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(16..=8192), help_heading = "Speed and accuracy", hide_short_help = true)]
    pub(crate) raster_width: u32,
    /// Folder for PNGs of each photo beside its rendering.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// A second set of poses of the same photos, in the splat's world: the similarity between both worlds follows
    /// from the camera centres, and is tried.
    #[arg(long, value_name = "PATH", help_heading = "Inputs", hide_short_help = true)]
    pub(crate) also_poses: Option<PathBuf>,
    /// Where splat and poses differ by a similarity (rotation, scale, translation), writes it into this file, in
    /// the format of nerfstudio's dataparser_transforms.json; `encode --splat-frame FILE` applies it.
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    pub(crate) write_frame: Option<PathBuf>,
}

pub(super) fn run(args: &CheckArgs, json: bool) -> Result<Exit> {
    let mut read = args.input.paths_read();
    read.extend(args.also_poses.as_deref());
    common::check(args.write_frame.as_deref(), &read, None)?;
    let (report, is_partial) = checked(args)?;
    let next = if report.diagnosis.is_none() { next::of_check(&args.input) } else { String::new() };
    print(json, &report, format!("{report}{next}"))?;
    Ok(match (&report.diagnosis, is_partial) {
        (Some(_), _) => Exit::Mismatch,
        (None, true) => Exit::Partly,
        (None, false) => Exit::Done,
    })
}

/// Returns the report, and whether something was left out or does not fit.
fn checked(args: &CheckArgs) -> Result<(CheckReport, bool)> {
    let input = &args.input;
    let mut scene = splat::read(&input.scene, &splat::ReadOptions { with_sh_rest: true })?;
    input.activated.undo(&mut scene);
    ingest::drop_broken_harmonics(&mut scene);
    let poses = input.views.as_ref();
    let poses = poses.context("check compares the splat with photos; give their poses with --views")?;
    args.write_frame.iter().try_for_each(|path| files::check_writable(path))?;
    let mut set = poses::read(poses, input.images.as_deref())?;
    let mut notes = std::mem::take(&mut set.notes);
    match ingest::n_drawn(&set.views) {
        0 => {}
        n => notes.push(format!(
            "{n} of the images are no photos: they were drawn from a splat, so that they fit says little"
        )),
    }
    let frame = match ingest::drawn_from(poses) {
        Some(_) => None,
        None => ingest::find_frame(&input.scene, &input.splat_frame, set.source, set.applied)?,
    };
    let frames = candidates(args, &set.views, frame.as_ref(), &mut notes)?;
    if let Some(n) = input.every {
        set = set.every(n);
    }
    notes.append(&mut set.notes);
    notes.extend(set.left_out());
    let n_left_out = set.damaged.len();
    // The similarity that a file states: the cameras are moved by it.
    let stated = frame.as_ref().map(FoundFrame::splat_from_poses);
    let mut views = set.views;
    if let Some(stated) = stated {
        for view in &mut views {
            view.camera_from_world = stated.camera_from_target(view.camera_from_world);
        }
    }
    let (n_views, suspicions) = (views.len(), check::suspicions(&scene, &views));
    check_near_plane(&scene, &views.iter().map(RasterView::of).collect::<Vec<_>>())?;
    let views = with_photos(views, input.strict, &mut notes)?;
    let is_partial = n_left_out > 0 || views.len() < n_views;
    let n = (args.samples as usize).min(views.len());
    // Photos are loaded one at a time, when the check reaches them.
    let odd = OddPhotos::default();
    let photos = (0..n).map(|i| load(&views[i * views.len() / n], &odd));
    let options = CheckOptions {
        width_px: args.raster_width,
        pictures_dir: args.out.clone(),
        frames,
        suspicions,
        ..CheckOptions::default()
    };
    let devices = Devices::open(&args.device, GpuOptions::default())?;
    let mut report = check::check(&scene, photos, &devices, &options)?;
    odd.warn();
    if let (true, Some(first)) = (input.strict, report.unreadable.first()) {
        return Err(anyhow!("{first}"));
    }
    // Cameras are in the stated frame already; reports and files begin at the poses.
    if let (Some(stated), Some(diagnosis)) = (stated, &mut report.diagnosis) {
        diagnosis.splat_from_poses = diagnosis.splat_from_poses.map(|found| found.after(&stated));
    }
    if let Some(path) = &args.write_frame {
        notes.push(write_frame(path, &report)?);
    }
    report.notes = notes;
    let is_partial =
        is_partial || !report.unreadable.is_empty() || report.views.iter().any(|view| !view.fits());
    Ok((report, is_partial))
}

fn with_photos(views: Vec<View>, is_strict: bool, notes: &mut Vec<String>) -> Result<Vec<View>> {
    let (missing, there): (Vec<View>, Vec<View>) = views.into_iter().partition(|v| !v.image_path.is_file());
    if let Some(first) = missing.first() {
        let (n, of) = (missing.len(), missing.len() + there.len());
        let message = format!("{n} of {of} photos are missing, the first is {}", first.image_path.display());
        if is_strict || there.is_empty() {
            return Err(anyhow!("{message}; give their folder with --images"));
        }
        notes.push(message);
    }
    Ok(there)
}

fn load(view: &View, odd: &OddPhotos) -> Result<CheckView, IngestError> {
    ingest::check_memory(view, free_memory_bytes().unwrap_or(u64::MAX))?;
    let loaded = ingest::load_image(view)?;
    odd.add(&loaded);
    Ok(loaded.into())
}

/// Returns the similarities to try; all begin after `frame`, if given.
fn candidates(
    args: &CheckArgs,
    views: &[View],
    frame: Option<&FoundFrame>,
    notes: &mut Vec<String>,
) -> Result<Vec<FrameCandidate>> {
    let mut found = Vec::new();
    if let Some(path) = &args.also_poses {
        let other = poses::read(path, None)?.views;
        let Alignment { similarity, n_cameras, residual } = check::align(views, &other)?;
        notes.push(format!(
            "{n_cameras} photos are in both sets of poses; a similarity of scale {:.6} brings them together, up to {:.2} \
             % of their spread",
            similarity.scale,
            100.0 * residual
        ));
        found.push(FrameCandidate { cause: FrameCause::OtherPoses, splat_from_poses: similarity });
    }
    found.extend(check::nerfstudio_defaults(views));
    if let Some(frame) = frame {
        notes.push(format!("{frame}; the cameras are drawn in the splat's world"));
        let poses_from_stated = frame.splat_from_poses().inverse();
        for candidate in &mut found {
            candidate.splat_from_poses = candidate.splat_from_poses.after(&poses_from_stated);
        }
        found.push(FrameCandidate {
            cause: FrameCause::FrameFileNotMeant,
            splat_from_poses: poses_from_stated,
        });
    }
    Ok(found)
}

/// Writes the found similarity, and returns a line about it.
fn write_frame(path: &Path, report: &CheckReport) -> Result<String> {
    let similarity = report.diagnosis.as_ref().and_then(|diagnosis| diagnosis.splat_from_poses);
    Ok(match (similarity, &report.diagnosis) {
        (Some(similarity), _) => {
            durable::write(path, SplatFrame::to_json(&similarity).as_bytes())
                .with_context(|| format!("cannot write {}", path.display()))?;
            format!("wrote {}; encode with --splat-frame {}", path.display(), path.display())
        }
        (None, None) => format!("{} not written: splat and poses have one frame already", path.display()),
        (None, Some(_)) => format!("{} not written: no similarity was found", path.display()),
    })
}
