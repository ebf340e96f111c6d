//! Common mistakes in poses and intrinsics, and their corrections.

use std::fmt;

use glam::{DAffine3, DMat3, DVec3};
use serde::Serialize;
use slag_common::Similarity;

use super::frames::{FrameCandidate, from_axes, right_angles, write_axes};
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
    /// The worlds differ by right angles: axis i of the splat's is this axis of the cameras', counted from 1, with its
    /// sign.
    WorldAxes([i8; 3]),
    /// The worlds differ by a similarity.
    Frame(FrameCandidate),
}

/// The wrong conventions of cameras.
pub(super) const CAMERA_CONVENTIONS: [Mistake; 3] =
    [Mistake::OpenGlAxes, Mistake::WorldFromCamera, Mistake::WorldFromOpenGlCamera];

/// Returns all mistakes that are tried by themselves, beside frames.
pub(super) fn single_mistakes() -> Vec<Mistake> {
    let scales = [0.01, 0.1, 10.0, 100.0].map(Mistake::SceneScale);
    let focals = [0.5, 2.0].map(Mistake::FocalScale);
    let axes = right_angles().into_iter().map(Mistake::WorldAxes);
    CAMERA_CONVENTIONS.into_iter().chain(scales).chain(focals).chain(axes).collect()
}

impl Mistake {
    /// Returns the similarity from the world of the poses to that of the splat; `None` for mistakes of cameras.
    pub fn splat_from_poses(self) -> Option<Similarity> {
        match self {
            Self::SceneScale(factor) => Some(Similarity::from_scale(factor)),
            Self::WorldAxes(axes) => Some(from_axes(axes)),
            Self::Frame(frame) => Some(frame.splat_from_poses),
            Self::OpenGlAxes | Self::WorldFromCamera | Self::WorldFromOpenGlCamera | Self::FocalScale(_) => {
                None
            }
        }
    }

    /// Returns the view with the mistake corrected.
    pub fn corrected(self, view: &RasterView) -> RasterView {
        let mut corrected = *view;
        let pose = &mut corrected.camera_from_world;
        let opencv_from_opengl = DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        match self {
            Self::OpenGlAxes => *pose = opencv_from_opengl * *pose,
            Self::WorldFromCamera => *pose = pose.inverse(),
            Self::WorldFromOpenGlCamera => *pose = opencv_from_opengl * pose.inverse(),
            Self::FocalScale(factor) => {
                corrected.intrinsics.focal_x_px *= factor;
                corrected.intrinsics.focal_y_px *= factor;
            }
            Self::SceneScale(_) | Self::WorldAxes(_) | Self::Frame(_) => {
                if let Some(similarity) = self.splat_from_poses() {
                    *pose = similarity.camera_from_target(*pose);
                }
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
            Self::SceneScale(factor) => {
                write!(
                    f,
                    "the scene is {factor:.4} times as large as the cameras' world; multiply the camera positions by \
                     {factor:.4}"
                )
            }
            Self::FocalScale(factor) => {
                write!(f, "the focal length belongs to another image size or sensor; multiply it by {factor}")
            }
            Self::WorldAxes(axes) => write_axes(*axes, f),
            Self::Frame(frame) => write!(f, "{}", frame.cause),
        }
    }
}
