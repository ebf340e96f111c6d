//! `locate`.

use std::path::PathBuf;

use clap::Args;
use glam::DVec3;

use crate::locate::{Answer, Camera, LocateError, answer};
use crate::query::parse_point;
use crate::store::Snapshot;

use super::args::CacheArgs;
use super::failure::{Failure, store_failure};
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
    #[arg(long, value_name = "PX", num_args = 2, value_delimiter = ',')]
    pub centre_px: Option<Vec<f64>>,
    /// Direction of gravity in the camera's frame (x right, y down, z forward), as an IMU measures it: poses that
    /// contradict it are refused.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    pub gravity: Option<DVec3>,
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

pub fn run(args: LocateArgs) -> Result<(), Failure> {
    let cache = args.cache.open()?;
    let snapshot = Snapshot::open(&cache).map_err(store_failure)?;
    let centre_px = args.centre_px.map(|centre| [centre[0], centre[1]]);
    let camera = Camera { focal_px: args.focal_px, centre_px, gravity: args.gravity };
    let found = answer(&snapshot, &args.photo, &camera).map_err(|error| match error {
        LocateError::Io(error) => error.into(),
        LocateError::Decode { .. } => Failure::Failed("photo", error.into()),
        LocateError::Version { .. } => Failure::Failed("store", error.into()),
    })?;
    if args.json {
        return print_json(&found);
    }
    match found {
        Answer::Lost { reason } => print_pairs(&[("lost", reason)]),
        Answer::Found { position_in_world, rotation_xyzw, covariance, n_inliers, geographic, .. } => {
            let numbers = |of: &[f64]| of.iter().map(|v| format!("{v:.4}")).collect::<Vec<_>>().join(",");
            // The standard deviation along the worst axis of the world.
            let sigma = [0, 7, 14].map(|at| covariance[at]).into_iter().fold(0.0, f64::max).sqrt();
            let mut pairs = vec![
                ("position", numbers(&position_in_world)),
                ("rotation_xyzw", numbers(&rotation_xyzw)),
                ("sigma", format!("{sigma:.4}")),
                ("landmarks", n_inliers.to_string()),
            ];
            if let Some(at) = geographic {
                let place = format!("{:.7},{:.7},{:.2}", at.latitude_deg, at.longitude_deg, at.height_m);
                pairs.push(("lat, lon, height", place));
            }
            print_pairs(&pairs)
        }
    }
}
