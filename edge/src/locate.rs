//! Finds the camera of a photo by the landmarks on board.

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use image::{ImageReader, Limits};
use serde::Serialize;
use slag_common::frames::Geographic;
use slag_common::{Distortion, Intrinsics};
use slag_locate::{CODE_VERSION, Grey, Located, Map, Outcome, Photo, locate};

use crate::store::Snapshot;

/// Largest side of a photo, pixels, and the bytes that decoding it may take.
const MAX_SIDE_PX: u32 = 16_384;
const MAX_DECODE_BYTES: u64 = 512 << 20;

/// Why a photo cannot be located at all.
#[derive(Debug, thiserror::Error)]
pub enum LocateError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] std::io::Error),
    #[error("{}: {source}; give a JPEG, PNG or WebP of at most {MAX_SIDE_PX} pixels a side", path.display())]
    Decode {
        path: PathBuf,
        #[source]
        source: image::ImageError,
    },
    #[error(
        "cell {cell_id} has landmarks of version {found}, this program matches version {CODE_VERSION}; use a program of the matching version, or encode again"
    )]
    Version { cell_id: u32, found: u32 },
}

#[derive(Clone, Copy, Debug)]
pub struct Camera {
    pub focal_px: f64,
    /// Principal point, pixels; the middle of the photo if absent.
    pub centre_px: Option<[f64; 2]>,
    /// Direction of gravity in the camera's frame (x right, y down, z forward).
    pub gravity: Option<DVec3>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Answer {
    Found {
        /// The camera, world frame; east, north, up of the scene's origin if it has one.
        position_in_world: [f64; 3],
        /// World from camera with REP-103's axes (x forward, y left, z up).
        rotation_xyzw: [f64; 4],
        /// World from camera with the axes of images (x right, y down, z forward).
        optical_rotation_xyzw: [f64; 4],
        /// Of x, y, z and rotations about the world's x, y, z; square world units and square radians, row by row.
        covariance: Vec<f64>,
        n_inliers: usize,
        #[serde(skip_serializing_if = "Option::is_none")]
        geographic: Option<Geographic>,
    },
    Lost {
        reason: String,
    },
}

/// Returns the landmarks on board.
pub fn map_on_board(snapshot: &Snapshot) -> Result<Map, LocateError> {
    let mut all = Vec::new();
    for shard in &snapshot.shards {
        let Some(landmarks) = shard.landmarks() else { continue };
        let found = landmarks.header.code_version;
        if found != CODE_VERSION {
            return Err(LocateError::Version { cell_id: shard.cell.cell_id, found });
        }
        all.extend(landmarks.iter());
    }
    Ok(Map::new(all))
}

/// Finds the camera of a photo. Same photo, same answer.
///
/// # Errors
/// [`LocateError`]. A photo that shows another place is no error: its answer is [`Answer::Lost`].
pub fn answer(snapshot: &Snapshot, photo: &Path, camera: &Camera) -> Result<Answer, LocateError> {
    let map = map_on_board(snapshot)?;
    let grey = read(photo)?;
    let (width, height) = (grey.width as f64, grey.height as f64);
    let [centre_x_px, centre_y_px] = camera.centre_px.unwrap_or([width / 2.0, height / 2.0]);
    let intrinsics = Intrinsics {
        width_px: grey.width as u32,
        height_px: grey.height as u32,
        focal_x_px: camera.focal_px,
        focal_y_px: camera.focal_px,
        centre_x_px,
        centre_y_px,
        distortion: Distortion::None,
    };
    let photo = Photo { grey: &grey, intrinsics: &intrinsics, gravity_in_camera: camera.gravity };
    Ok(match locate(&map, &photo, None) {
        Outcome::Found(found) => found_answer(snapshot, &found),
        Outcome::Lost(reason) => Answer::Lost { reason: reason.to_string() },
    })
}

fn found_answer(snapshot: &Snapshot, found: &Located) -> Answer {
    let world_from_camera = found.camera_from_world.inverse();
    // Of the image's axes: forward is z, left is -x, up is -y.
    let camera_from_body = DMat3::from_cols(DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y);
    let rotation = |matrix: DMat3| DQuat::from_mat3(&matrix).normalize().to_array();
    let at = world_from_camera.translation;
    Answer::Found {
        position_in_world: at.to_array(),
        rotation_xyzw: rotation(world_from_camera.matrix3 * camera_from_body),
        optical_rotation_xyzw: rotation(world_from_camera.matrix3),
        covariance: found.covariance.to_vec(),
        n_inliers: found.n_inliers,
        geographic: snapshot.manifest.geo_reference.map(|geo| geo.geographic_from_world(at)),
    }
}

fn read(path: &Path) -> Result<Grey, LocateError> {
    let mut reader =
        ImageReader::new(std::io::BufReader::new(fs_err::File::open(path)?)).with_guessed_format()?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(MAX_DECODE_BYTES);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|source| LocateError::Decode { path: path.to_owned(), source })?;
    let rgb = decoded.into_rgb8();
    Ok(Grey::from_rgb8(rgb.width() as usize, rgb.height() as usize, rgb.as_raw()))
}

#[cfg(test)]
mod tests;
