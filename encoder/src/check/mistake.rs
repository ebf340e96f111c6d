//! Common mistakes in poses and intrinsics, and their corrections.

use std::fmt;

use glam::{DAffine3, DMat3, DVec3};
use serde::Serialize;

use crate::raster::RasterView;

/// A common mistake in poses or intrinsics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Mistake {
    /// The camera axes are OpenGL's (x right, y up, z back).
    OpenGlAxes,
    /// The transforms are world-from-camera.
    WorldFromCamera,
    /// Both, as in a NeRF `transforms.json`.
    WorldFromOpenGlCamera,
    /// The scene is larger than the cameras' world by this factor.
    SceneScale(f64),
    /// The focal lengths must be multiplied by this factor.
    FocalScale(f64),
    /// The scene must be rotated about the world's x axis by this many quarter turns (y up instead of z up, or the
    /// reverse).
    WorldQuarterTurns(u8),
}

/// All mistakes that are tried.
pub(super) const MISTAKES: [Mistake; 12] = [
    Mistake::OpenGlAxes,
    Mistake::WorldFromCamera,
    Mistake::WorldFromOpenGlCamera,
    Mistake::SceneScale(0.01),
    Mistake::SceneScale(0.1),
    Mistake::SceneScale(10.0),
    Mistake::SceneScale(100.0),
    Mistake::FocalScale(0.5),
    Mistake::FocalScale(2.0),
    Mistake::WorldQuarterTurns(1),
    Mistake::WorldQuarterTurns(2),
    Mistake::WorldQuarterTurns(3),
];

impl Mistake {
    /// Returns the view with the mistake corrected.
    pub fn corrected(self, view: &RasterView) -> RasterView {
        let mut corrected = *view;
        let pose = &mut corrected.camera_from_world;
        let opencv_from_opengl = DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        match self {
            Self::OpenGlAxes => *pose = opencv_from_opengl * *pose,
            Self::WorldFromCamera => *pose = pose.inverse(),
            Self::WorldFromOpenGlCamera => *pose = opencv_from_opengl * pose.inverse(),
            Self::SceneScale(factor) => pose.translation *= factor,
            Self::FocalScale(factor) => {
                corrected.intrinsics.focal_x_px *= factor;
                corrected.intrinsics.focal_y_px *= factor;
            }
            Self::WorldQuarterTurns(quarters) => {
                let angle_rad = f64::from(quarters) * std::f64::consts::FRAC_PI_2;
                *pose *= DAffine3::from_rotation_x(angle_rad);
            }
        }
        corrected
    }
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OpenGlAxes => {
                write!(f, "the poses have OpenGL camera axes; negate the y and z rows of camera-from-world")
            }
            Self::WorldFromCamera => write!(f, "the poses are world-from-camera; invert them"),
            Self::WorldFromOpenGlCamera => write!(
                f,
                "the poses are world-from-camera with OpenGL axes; invert them, then negate the y and z rows"
            ),
            Self::SceneScale(factor) => write!(
                f,
                "the scene is {factor} times as large as the cameras' world; multiply the camera positions by {factor}"
            ),
            Self::FocalScale(factor) => {
                write!(f, "the focal length belongs to another image size or sensor; multiply it by {factor}")
            }
            Self::WorldQuarterTurns(quarters) => write!(
                f,
                "scene and cameras differ in their up axis; rotate the scene by {} degrees about x",
                u32::from(*quarters) * 90
            ),
        }
    }
}
