//! A furnished room that the project makes itself: Gaussians, photos, poses and truth, from a seed.
//!
//! Every surface is covered with flat Gaussians; the photos are drawn from them by the project's own
//! rasteriser, along a walk through the room. What stands where is the truth to check answers by.

pub mod field;
mod room;
mod solid;

use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use image::RgbImage;
use serde::Serialize;
use slag_common::splat::{self, SplatError};
use slag_common::{Distortion, Gaussians, Intrinsics};

use crate::progress::Progress;
use crate::raster::{CpuRasterizer, Drawing, RasterError, RasterView, Rasterizer};
pub use room::TrueObject;

/// Size of the photos.
const PHOTO_PX: [u32; 2] = [640, 480];
/// Horizontal field of view, 75 degrees: a phone's wide camera.
const FIELD_OF_VIEW_RAD: f64 = 75.0 * std::f64::consts::PI / 180.0;
/// Height of the camera over the floor.
const CAMERA_HEIGHT_M: f64 = 1.5;

/// A generated scene.
pub struct Room {
    /// The Gaussians; metres, z up.
    pub gaussians: Gaussians,
    /// What stands where.
    pub objects: Vec<TrueObject>,
    /// The cameras of the photos.
    pub views: Vec<RasterView>,
}

/// Where a generated scene was written.
pub struct WrittenRoom {
    /// The splat.
    pub scene: PathBuf,
    /// The poses.
    pub views: PathBuf,
}

/// Why a scene could not be written.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// A file could not be written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The splat could not be written.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// A photo could not be drawn.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A photo could not be written.
    #[error("{}: {source}", path.display())]
    Image {
        /// The photo.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
}

/// Makes a room. The same seed gives the same room.
pub fn room(seed: u64, n_views: u32) -> Room {
    let (gaussians, objects) = room::build(seed);
    Room { gaussians, objects, views: walk(n_views) }
}

/// Returns cameras on an oval walk around the room's middle, looking outwards and across in turn.
fn walk(n_views: u32) -> Vec<RasterView> {
    let [width_px, height_px] = PHOTO_PX;
    let focal_px = f64::from(width_px) / 2.0 / (FIELD_OF_VIEW_RAD / 2.0).tan();
    let intrinsics = Intrinsics {
        width_px,
        height_px,
        focal_x_px: focal_px,
        focal_y_px: focal_px,
        centre_x_px: f64::from(width_px) / 2.0,
        centre_y_px: f64::from(height_px) / 2.0,
        distortion: Distortion::None,
    };
    let middle = DVec3::new(room::SIZE_M.x / 2.0, room::SIZE_M.y / 2.0, 0.0);
    (0..n_views)
        .map(|i| {
            let angle = std::f64::consts::TAU * f64::from(i) / f64::from(n_views);
            let direction = DVec3::new(angle.cos(), angle.sin(), 0.0);
            let across = i % 2 == 1;
            let away = if across { 0.30 } else { 0.10 };
            let position = middle + direction * room::SIZE_M * away + DVec3::Z * CAMERA_HEIGHT_M;
            let heading = if across { -direction } else { direction };
            RasterView { camera_from_world: looking(position, heading - DVec3::Z * 0.35), intrinsics }
        })
        .collect()
}

/// Returns the pose of a camera at `position` that looks along `heading`, upright.
fn looking(position: DVec3, heading: DVec3) -> DAffine3 {
    let forward = heading.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let down = forward.cross(right);
    let camera_from_world = DMat3::from_cols(right, down, forward).transpose();
    DAffine3::from_mat3_translation(camera_from_world, -(camera_from_world * position))
}

impl Room {
    /// Writes `scene.ply`, `images/`, `transforms.json` and `truth.json` into a folder.
    ///
    /// # Errors
    /// [`GenerateError`].
    pub fn write(&self, folder: &Path, progress: &dyn Progress) -> Result<WrittenRoom, GenerateError> {
        #[derive(Serialize)]
        struct Frame {
            file_path: String,
            transform_matrix: [[f64; 4]; 4],
        }
        #[derive(Serialize)]
        struct Transforms {
            camera_model: &'static str,
            fl_x: f64,
            fl_y: f64,
            cx: f64,
            cy: f64,
            w: u32,
            h: u32,
            frames: Vec<Frame>,
        }
        fs_err::create_dir_all(folder.join("images"))?;
        let scene = folder.join("scene.ply");
        splat::ply::write(&scene, &self.gaussians)?;
        progress.begin("photos", "photo", self.views.len() as u64, 0);
        let mut frames = Vec::new();
        for (i, view) in self.views.iter().enumerate() {
            let file_path = format!("images/{i:04}.png");
            let path = folder.join(&file_path);
            let photo = to_image(&CpuRasterizer.draw(&self.gaussians, view, [0.0; 3])?, view);
            photo.save(&path).map_err(|source| GenerateError::Image { path, source })?;
            // The file format has OpenGL axes: y up, z backward.
            let world_from_camera = view.camera_from_world.inverse();
            let [x, y, z] = world_from_camera.matrix3.to_cols_array_2d().map(DVec3::from);
            let columns = [x, -y, -z, world_from_camera.translation];
            let row = |r: usize| columns.map(|c| c[r]);
            frames
                .push(Frame { file_path, transform_matrix: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]] });
            progress.advance(1);
        }
        progress.end();
        let views = folder.join("transforms.json");
        if let Some(RasterView { intrinsics, .. }) = self.views.first() {
            let transforms = Transforms {
                camera_model: "PINHOLE",
                fl_x: intrinsics.focal_x_px,
                fl_y: intrinsics.focal_y_px,
                cx: intrinsics.centre_x_px,
                cy: intrinsics.centre_y_px,
                w: intrinsics.width_px,
                h: intrinsics.height_px,
                frames,
            };
            fs_err::write(&views, serde_json::to_vec_pretty(&transforms).map_err(std::io::Error::from)?)?;
        }
        let truth = serde_json::to_vec_pretty(&self.objects).map_err(std::io::Error::from)?;
        fs_err::write(folder.join("truth.json"), truth)?;
        Ok(WrittenRoom { scene, views })
    }
}

/// Returns a drawing as 8-bit RGB.
pub(crate) fn to_image(drawing: &Drawing, view: &RasterView) -> RgbImage {
    let bytes = drawing.rgb.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    RgbImage::from_raw(view.intrinsics.width_px, view.intrinsics.height_px, bytes)
        .expect("a drawing has three values a pixel of its view")
}
