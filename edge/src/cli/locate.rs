//! `locate`.

use std::path::{Path, PathBuf};

use clap::Args;
use glam::DVec3;
use slag_common::files;
use slag_locate::Prior;

use crate::locate::{Answer, Camera, LocateError, MAX_PHOTO_BYTES, PhotoFile, Pose, Verification, answer};
use crate::query::{numbers, parse_point};
use crate::score::Budget;
use crate::store::Snapshot;

use super::args::{CacheArgs, parse_reach};
use super::failure::Failure;
use super::output::{print_json, print_pairs};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge locate photo.jpg --focal-px 554.3\n\
    \x20 slag-edge locate photo.jpg --focal-px 554.3 --gravity 0,1,0 --json\n\
    \x20 slag-edge locate photo.jpg --focal-px 554.3 --cache /var/lib/slag\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct LocateArgs {
    /// Photo: JPEG, PNG or WebP, without lens distortion.
    pub photo: PathBuf,
    /// Focal length, pixels of the photo.
    #[arg(long, value_name = "PX", value_parser = parse_focal)]
    pub focal_px: f64,
    /// Principal point, pixels from the left and the top [default: the middle of the photo].
    #[arg(long, value_name = "X,Y", value_parser = parse_centre)]
    pub centre_px: Option<[f64; 2]>,
    /// Direction of gravity in the camera's frame (x right, y down, z forward), opposite to what an accelerometer at rest
    /// measures: poses that contradict it are refused.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    pub gravity: Option<DVec3>,
    /// Where the camera may be, world frame, with --sigma: poses elsewhere are refused.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, requires = "sigma", allow_hyphen_values = true)]
    pub near: Option<DVec3>,
    /// Standard deviation of --near, world units: poses beyond three of it are refused.
    #[arg(long, value_name = "UNITS", value_parser = parse_reach, requires = "near")]
    pub sigma: Option<f64>,
    #[command(flatten)]
    pub cache: CacheArgs,
    /// Print the answer as JSON.
    #[arg(long)]
    pub json: bool,
}

fn parse_focal(text: &str) -> Result<f64, String> {
    let focal = text.parse().ok().filter(|focal: &f64| *focal >= 1.0 && focal.is_finite());
    focal.ok_or_else(|| "expected pixels, at least 1".into())
}

fn parse_centre(text: &str) -> Result<[f64; 2], String> {
    numbers(text).and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| "expected pixels X,Y".into())
}

pub fn run(args: LocateArgs) -> Result<(), Failure> {
    let cache = args.cache.open()?;
    let snapshot = Snapshot::open(&cache)?;
    let prior =
        args.near.zip(args.sigma).map(|(position_in_world, sigma)| Prior { position_in_world, sigma });
    let camera = Camera { focal_px: args.focal_px, centre_px: args.centre_px, gravity: args.gravity, prior };
    let found = located(&snapshot, &args.photo, &camera)?;
    if args.json {
        return print_json(&found);
    }
    match found {
        Answer::Found(pose) => print_pairs(&pairs(&pose)),
        Answer::Unsure { reason, candidates } => {
            print_pairs(&[("unsure", reason)])?;
            candidates.iter().try_for_each(|pose| print_pairs(&pairs(pose)))
        }
        Answer::Lost { reason } => print_pairs(&[("lost", reason)]),
    }
}

fn located(snapshot: &Snapshot, photo: &Path, camera: &Camera) -> Result<Answer, Failure> {
    let of_photo = |error: LocateError| match error {
        LocateError::Version { .. } => Failure::failed("store", error),
        error => Failure::failed("photo", anyhow::anyhow!("{}: {error}", photo.display())),
    };
    let bytes = files::read_short(photo, MAX_PHOTO_BYTES as u64)?;
    PhotoFile::open(&bytes)
        .and_then(|opened| answer(snapshot, opened, camera, &Budget::default()))
        .map_err(of_photo)
}

fn pairs(pose: &Pose) -> Vec<(&'static str, String)> {
    let numbers = |of: &[f64]| of.iter().map(|v| format!("{v:.4}")).collect::<Vec<_>>().join(",");
    let mut pairs = vec![
        ("position", numbers(&pose.position_in_world)),
        ("rotation_xyzw", numbers(&pose.rotation_xyzw)),
        ("sigma", format!("{:.4}", pose.position_sigma())),
        (
            "verified by",
            match pose.verified_by {
                Verification::Landmarks => format!("{} landmarks", pose.n_inliers),
                Verification::Rendering => format!("{} points of a rendering", pose.n_inliers),
            },
        ),
    ];
    if let Some(at) = pose.geographic {
        let place = format!("{:.7},{:.7},{:.2}", at.latitude_deg, at.longitude_deg, at.height_m);
        pairs.push(("lat, lon, height", place));
    }
    pairs
}
