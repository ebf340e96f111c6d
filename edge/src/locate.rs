//! Finds the camera of a photo by the landmarks on board.

use std::io::Cursor;

use glam::{DMat3, DQuat, DVec2, DVec3};
use image::{DynamicImage, ImageDecoder};
pub use slag_api::locate::{Answer, Pose, Verification};
use slag_common::photo::{self, HEAD_BYTES, PhotoError};
use slag_common::{Intrinsics, pinhole};
use slag_locate::{
    CODE_VERSION, Grey, Located, Map, Outcome, Photo, Pinhole, Prior, Renderer, locate, map_bytes,
    working_bytes,
};
use slag_service::params::RequestError;

use self::render::OnBoard;
use crate::score::Budget;
use crate::store::Snapshot;

mod render;

pub const MAX_PHOTO_BYTES: usize = 32 << 20;
/// Largest side of a photo, pixels, and most pixels.
const MAX_SIDE_PX: u32 = 16_384;
const MAX_PX: u64 = 50_000_000;
/// Least length of a direction of gravity, in whatever unit.
const MIN_GRAVITY: f64 = 1e-6;

#[derive(Debug, thiserror::Error)]
pub enum LocateError {
    #[error("{0}")]
    Photo(String),
    #[error(transparent)]
    Camera(#[from] RequestError),
    #[error(
        "cell {cell_id} has landmarks of version {found}, this program matches version {CODE_VERSION}; use a program of the matching version, or encode again"
    )]
    Version { cell_id: u32, found: u32 },
}

impl From<PhotoError> for LocateError {
    fn from(error: PhotoError) -> Self {
        Self::Photo(format!("no photo: {error}"))
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Camera {
    pub focal_px: f64,
    /// Principal point, pixels; the middle of the photo if absent.
    pub centre_px: Option<[f64; 2]>,
    /// Direction of gravity in the camera's frame (x right, y down, z forward).
    pub gravity: Option<DVec3>,
    pub prior: Option<Prior>,
}

/// A photo with known size and unread pixels.
pub struct PhotoFile<'a> {
    decoder: Box<dyn ImageDecoder + 'a>,
}

impl<'a> PhotoFile<'a> {
    /// Reads the header of a JPEG, PNG or WebP, with at most [`Self::opening_bytes`].
    ///
    /// # Errors
    /// The bytes are no such picture, one that lost a piece, or one that is too large.
    pub fn open(bytes: &'a [u8]) -> Result<Self, LocateError> {
        let decoder = photo::open(Cursor::new(bytes))?;
        let (width, height) = decoder.dimensions();
        if width.max(height) > MAX_SIDE_PX || u64::from(width) * u64::from(height) > MAX_PX {
            return Err(LocateError::Photo(format!(
                "the photo has {width} x {height} pixels, expected at most {MAX_SIDE_PX} a side and {MAX_PX} in all"
            )));
        }
        Ok(Self { decoder })
    }

    /// Returns the most bytes that opening a file takes, whatever its header says; in use until it is located.
    pub fn opening_bytes(file: &[u8]) -> usize {
        HEAD_BYTES as usize + file.len()
    }

    /// Returns the most bytes that locating it takes, besides opening and the map.
    pub fn working_bytes(&self) -> usize {
        let (width, height) = self.decoder.dimensions();
        let n_px = width as usize * height as usize;
        // Decoding: pixels as stored, as RGB, and a progressive JPEG's coefficients. Then grey.
        let decoding = self.decoder.total_bytes() as usize + n_px * (3 + 6);
        decoding.max(n_px * size_of::<f32>() + working_bytes(width as usize, height as usize))
    }

    fn grey(self) -> Result<Grey, LocateError> {
        let decoded = DynamicImage::from_decoder(self.decoder).map_err(PhotoError::from)?;
        let (rgb, opaque) = photo::colours(decoded);
        if opaque.is_some_and(|opaque| !opaque.contains(&true)) {
            let what = "nothing of the photo is seen: it is transparent; give another copy";
            return Err(LocateError::Photo(what.to_owned()));
        }
        Ok(Grey::from_rgb8(rgb.width() as usize, rgb.height() as usize, rgb.as_raw()))
    }
}

pub fn map_working_bytes(snapshot: &Snapshot) -> usize {
    let landmarks = snapshot.shards.iter().filter_map(|shard| shard.additions().landmarks);
    map_bytes(landmarks.map(|landmarks| landmarks.len()).sum())
}

pub fn map_on_board(snapshot: &Snapshot) -> Result<Map, LocateError> {
    let mut all = Vec::new();
    for shard in &snapshot.shards {
        let Some(landmarks) = shard.additions().landmarks else { continue };
        let found = landmarks.header.code_version;
        if found != CODE_VERSION {
            return Err(LocateError::Version { cell_id: shard.cell.cell_id, found });
        }
        all.extend(landmarks.iter());
    }
    Ok(Map::new(all))
}

/// Finds the camera of a photo. Same photo, same answer. Where cells have an appearance and the budget allows it,
/// rendered pictures verify and improve the pose.
///
/// # Errors
/// [`LocateError`]. A photo that shows another place is no error: its answer is [`Answer::Lost`].
pub fn answer(
    snapshot: &Snapshot,
    photo: PhotoFile<'_>,
    camera: &Camera,
    budget: &Budget,
) -> Result<Answer, LocateError> {
    let map = map_on_board(snapshot)?;
    let grey = photo.grey()?;
    let (width, height) = (grey.width as f64, grey.height as f64);
    let [centre_x_px, centre_y_px] = camera.centre_px.unwrap_or([width / 2.0, height / 2.0]);
    // With an impossible principal point, a distant pose may fit the photo.
    if !((0.0..=width).contains(&centre_x_px) && (0.0..=height).contains(&centre_y_px)) {
        let expected = format!("a point of the photo, which has {width} x {height} pixels");
        let found = format!("{centre_x_px},{centre_y_px}");
        return Err(RequestError::new("centre_px", &found, expected).into());
    }
    // The squares of very short ones are 0: they would contradict nothing.
    let is_direction = |gravity: &DVec3| (MIN_GRAVITY..f64::INFINITY).contains(&gravity.length());
    if let Some(gravity) = camera.gravity.filter(|gravity| !is_direction(gravity)) {
        let expected = format!("a direction, {MIN_GRAVITY} or longer");
        let found = gravity.to_array().map(|v| v.to_string()).join(",");
        return Err(RequestError::new("gravity", &found, expected).into());
    }
    let intrinsics = Intrinsics {
        centre_x_px,
        centre_y_px,
        ..pinhole([grey.width as u32, grey.height as u32], camera.focal_px)
    };
    let (gravity_in_camera, prior) = (camera.gravity, camera.prior);
    let photo = Photo { grey: &grey, intrinsics: &intrinsics, gravity_in_camera, prior };
    let pose = |located: &Located| pose_of(snapshot, located);
    let on_board = OnBoard::of(snapshot, budget);
    let renderer = on_board.as_ref().map(|on_board| on_board as &dyn Renderer);
    Ok(match locate(&map, &photo, renderer) {
        Outcome::Found(found) => Answer::Found(pose(&found)),
        Outcome::Unsure(candidates) => {
            let reason = match candidates.as_slice() {
                [Located { other_camera: Some(other), .. }, ..] => contradiction(other, &intrinsics),
                [_] => "too few landmarks agree with the best pose".into(),
                _ => "poses in several places agree with the photo".into(),
            };
            Answer::Unsure { reason, candidates: candidates.iter().map(pose).collect() }
        }
        Outcome::Lost(reason) => Answer::Lost { reason: reason.to_string() },
    })
}

fn contradiction(other: &Pinhole, stated: &Intrinsics) -> String {
    let aspect = other.focal.y / other.focal.x;
    if aspect == 1.0 && other.centre == DVec2::new(stated.centre_x_px, stated.centre_y_px) {
        return format!(
            "the landmarks fit a focal length of {:.0} px better than the stated {:.0} px: is the photo a smaller copy, zoomed, or cropped?",
            other.focal.x, stated.focal_x_px
        );
    }
    format!(
        "the landmarks fit a camera with its centre at {:.0},{:.0} and a vertical focal length of {aspect:.2} times the \
         horizontal one better than the stated one (centre {:.0},{:.0}): is the photo cropped (give centre_px) or stretched?",
        other.centre.x, other.centre.y, stated.centre_x_px, stated.centre_y_px
    )
}

fn pose_of(snapshot: &Snapshot, located: &Located) -> Pose {
    let world_from_camera = located.camera_from_world.inverse();
    // In the image's axes, forward is z, left is -x, up is -y.
    let camera_from_body = DMat3::from_cols(DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y);
    let rotation = |matrix: DMat3| DQuat::from_mat3(&matrix).normalize().to_array();
    let at = world_from_camera.translation;
    Pose {
        position_in_world: at.to_array(),
        rotation_xyzw: rotation(world_from_camera.matrix3 * camera_from_body),
        optical_rotation_xyzw: rotation(world_from_camera.matrix3),
        covariance: located.covariance.to_vec(),
        n_inliers: located.n_inliers,
        verified_by: if located.is_verified { Verification::Rendering } else { Verification::Landmarks },
        geographic: snapshot.manifest.geo_reference.map(|geo| geo.geographic_from_world(at)),
    }
}

#[cfg(test)]
mod tests;
