//! Nerfstudio's `transforms.json` (its documentation, "Data conventions").
//!
//! `transform_matrix` is world from camera in OpenGL axes (x right, y up, z backward). An
//! `applied_transform` says how the world was moved before; it is left as it is, so that the world
//! frame is the one that the scene was trained in.

use std::f64::consts::PI;
use std::path::{Component, Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use serde::Deserialize;

use super::{
    Place, PoseError, PoseProblem, PoseSource, ViewSet, affine_from_matrix, check_intrinsics, parent,
    view_set,
};
use crate::camera::{Distortion, Intrinsics, View};

/// Endings tried for a `file_path` that has none, in this order.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "webp", "PNG", "JPG"];

/// The camera of a frame, or of all frames that say nothing else.
#[derive(Clone, Default, Deserialize)]
struct Camera {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    camera: Camera,
}

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    camera: Camera,
    frames: Vec<Frame>,
}

pub(super) fn read(path: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    let bytes = fs_err::read(path)?;
    let transforms: Transforms =
        serde_json::from_slice(&bytes).map_err(|source| PoseError::Json { path: path.to_owned(), source })?;
    let folder = parent(path)?;
    let mut views = Vec::new();
    for (index, frame) in transforms.frames.iter().enumerate() {
        let view = view(frame, &transforms.camera, &folder, images_dir);
        views.push(view.map_err(|problem| problem.at(path, Place::Frame(index)))?);
    }
    view_set(path, views, PoseSource::Transforms)
}

fn view(
    frame: &Frame,
    shared: &Camera,
    folder: &Path,
    images_dir: Option<&Path>,
) -> Result<View, PoseProblem> {
    let file_path = frame.file_path.replace('\\', "/");
    let name = name_of(&file_path).ok_or_else(|| PoseProblem::UnsafeName { image: file_path.clone() })?;
    let (image_path, ending) = match images_dir {
        Some(dir) => existing(&dir.join(&name)),
        None => existing(&folder.join(&file_path)),
    };
    let name = name + &ending;
    let world_from_camera = world_from_camera(&name, &frame.transform_matrix)?;
    let camera = frame.camera.clone().or(shared);
    let intrinsics = camera.intrinsics(&name, &image_path)?;
    Ok(View { name, image_path, intrinsics, camera_from_world: world_from_camera.inverse() })
}

/// Returns a frame's name: its path without what lies before and at the image folder.
///
/// The image folder is the first one called `images` or `images_N` (nerfstudio's downscaled
/// copies), so that names agree with COLMAP's; else it is the folder of the file.
fn name_of(file_path: &str) -> Option<String> {
    let parts: Vec<&str> = Path::new(file_path)
        .components()
        .filter_map(|part| match part {
            Component::Normal(part) => part.to_str(),
            _ => None,
        })
        .collect();
    let is_image_folder = |part: &str| {
        part.strip_prefix("images").is_some_and(|rest| {
            rest.is_empty()
                || rest
                    .strip_prefix('_')
                    .is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
        })
    };
    let (_file, folders) = parts.split_last()?;
    let start = folders.iter().position(|part| is_image_folder(part)).map_or(0, |at| at + 1);
    let name = parts.get(start..)?.join("/");
    (!name.contains('\0')).then_some(name)
}

/// Returns the path as it is or, where it has no image ending, with the first one that exists, and
/// what was added.
fn existing(path: &Path) -> (PathBuf, String) {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    if EXTENSIONS.iter().any(|e| e.eq_ignore_ascii_case(ending)) || path.is_file() {
        return (path.to_owned(), String::new());
    }
    for extension in EXTENSIONS {
        // Appended, not replaced: `frame.0001` has no ending that could be replaced.
        let mut longer = path.as_os_str().to_owned();
        longer.push(format!(".{extension}"));
        if Path::new(&longer).is_file() {
            return (longer.into(), format!(".{extension}"));
        }
    }
    (path.to_owned(), String::new())
}

fn world_from_camera(image: &str, rows: &[Vec<f64>]) -> Result<DAffine3, PoseProblem> {
    let expected = "a transform_matrix of 3 or 4 rows and 4 columns, the fourth row being 0 0 0 1";
    let row = |index: usize| rows.get(index).and_then(|row| <[f64; 4]>::try_from(row.as_slice()).ok());
    let ([Some(a), Some(b), Some(c)], true) = ([row(0), row(1), row(2)], matches!(rows.len(), 3 | 4)) else {
        return Err(PoseProblem::Expected { expected, found: format!("{} rows", rows.len()) });
    };
    if rows.len() == 4 && row(3) != Some([0.0, 0.0, 0.0, 1.0]) {
        return Err(PoseProblem::Expected { expected, found: format!("{:?}", rows[3]) });
    }
    let opencv_axes_in_opengl = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let rotation = DMat3::from_cols_array_2d(&[0, 1, 2].map(|column| [a[column], b[column], c[column]]));
    affine_from_matrix(image, rotation * opencv_axes_in_opengl, [a[3], b[3], c[3]])
}

impl Camera {
    /// Returns this camera with what it lacks taken from `shared`.
    fn or(self, shared: &Self) -> Self {
        // A frame's own angle goes before a shared focal length.
        let unless = |own: Option<f64>, value: Option<f64>| if own.is_some() { None } else { value };
        Self {
            camera_model: self.camera_model.or_else(|| shared.camera_model.clone()),
            is_fisheye: self.is_fisheye.or(shared.is_fisheye),
            camera_angle_x: self.camera_angle_x.or(shared.camera_angle_x),
            camera_angle_y: self.camera_angle_y.or(shared.camera_angle_y),
            fl_x: self.fl_x.or(unless(self.camera_angle_x, shared.fl_x)),
            fl_y: self.fl_y.or(unless(self.camera_angle_y, shared.fl_y)),
            cx: self.cx.or(shared.cx),
            cy: self.cy.or(shared.cy),
            w: self.w.or(shared.w),
            h: self.h.or(shared.h),
            k1: self.k1.or(shared.k1),
            k2: self.k2.or(shared.k2),
            k3: self.k3.or(shared.k3),
            k4: self.k4.or(shared.k4),
            p1: self.p1.or(shared.p1),
            p2: self.p2.or(shared.p2),
        }
    }

    fn intrinsics(&self, image: &str, image_path: &Path) -> Result<Intrinsics, PoseProblem> {
        let [width_px, height_px] = match (self.w, self.h) {
            (Some(w), Some(h)) => [w, h],
            // NeRF's first data sets say the size nowhere but in the images.
            _ => image::image_dimensions(image_path)
                .map(|(w, h)| [f64::from(w), f64::from(h)])
                .map_err(|_| PoseProblem::MissingIntrinsics { image: image.to_owned(), field: "w and h" })?,
        };
        let focal = |length: Option<f64>, angle: Option<f64>, side_px: f64| {
            length.or_else(|| angle.filter(|a| *a > 0.0 && *a < PI).map(|a| 0.5 * side_px / (0.5 * a).tan()))
        };
        let focal_x_px = focal(self.fl_x, self.camera_angle_x, width_px).ok_or_else(|| {
            PoseProblem::MissingIntrinsics { image: image.to_owned(), field: "fl_x or camera_angle_x" }
        })?;
        let focal_y_px = focal(self.fl_y, self.camera_angle_y, height_px).unwrap_or(focal_x_px);
        let centre_px = [self.cx.unwrap_or(0.5 * width_px), self.cy.unwrap_or(0.5 * height_px)];
        check_intrinsics([width_px, height_px], [focal_x_px, focal_y_px], centre_px, self.distortion()?)
    }

    /// Returns the lens; as in nerfstudio, every perspective model may carry coefficients.
    fn distortion(&self) -> Result<Distortion, PoseProblem> {
        let [k1, k2, k3, k4, p1, p2] =
            [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2].map(|c| c.unwrap_or(0.0));
        let fallback = if self.is_fisheye == Some(true) { "OPENCV_FISHEYE" } else { "OPENCV" };
        match self.camera_model.as_deref().unwrap_or(fallback) {
            "OPENCV_FISHEYE" => Ok(Distortion::Fisheye { k: [k1, k2, k3, k4] }),
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" if k4 == 0.0 => {
                Ok(Distortion::Brown { k: [k1, k2, k3], p: [p1, p2] })
            }
            model => {
                let with = if k4 == 0.0 { "" } else { " with k4" };
                Err(PoseProblem::UnsupportedLens {
                    model: format!("{model}{with}").chars().take(60).collect(),
                })
            }
        }
    }
}
