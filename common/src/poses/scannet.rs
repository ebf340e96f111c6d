//! Scene folders as ScanNet's SensReader exports them (Dai et al. 2017).
//!
//! ```text
//! SCENE/color/0.jpg                       photos
//! SCENE/pose/0.txt                        world from camera, 4 x 4, OpenCV axes, metres; -inf where tracking was lost
//! SCENE/intrinsic/intrinsic_color.txt     camera matrix, 4 x 4, of photos in their full size
//! ```
//!
//! `extrinsic_color.txt` and depth images are not read; nerfstudio's ScanNet dataparser does not read them either.

use std::io::{self, Read};
use std::path::Path;

use fs_err::File;
use glam::DMat3;

use super::checks::{affine_from_rows, check_intrinsics};
use super::error::{Place, PoseError, PoseProblem};
use super::transforms::existing;
use super::view_set::{Damaged, PoseSource, ViewSet, view_set};
use crate::camera::{Distortion, Intrinsics, View};
use crate::{files, photo};

pub(super) const POSES: &str = "pose";
const PHOTOS: &str = "color";
const INTRINSICS: &str = "intrinsic/intrinsic_color.txt";
/// Largest size of a file with one matrix: 16 numbers of 200 characters.
const MAX_MATRIX_BYTES: u64 = 4096;
/// Largest distance of the principal point from the middle of the image, in image sides.
const MAX_OFF_CENTRE: f64 = 0.25;

enum Matrix {
    Known(Vec<Vec<f64>>),
    /// A value is `-inf`: tracking was lost.
    Lost,
    Damaged(PoseProblem, Place),
}

pub(super) fn read(dir: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    let photos = images_dir.map_or_else(|| dir.join(PHOTOS), Path::to_owned);
    let intrinsics_path = dir.join(INTRINSICS);
    let camera = match read_matrix(&intrinsics_path)? {
        Matrix::Known(camera) => camera,
        Matrix::Lost => {
            return Err(PoseProblem::expected("a camera matrix", "-inf").at(&intrinsics_path, Place::File));
        }
        Matrix::Damaged(problem, place) => return Err(problem.at(&intrinsics_path, place)),
    };
    let mut stems = Vec::new();
    for entry in fs_err::read_dir(dir.join(POSES))? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "txt") {
            match path.file_stem().and_then(|stem| stem.to_str()) {
                Some(stem) => stems.push(stem.to_owned()),
                None => {
                    let name = path.display().to_string();
                    return Err(PoseProblem::unsafe_name(&name).at(&path, Place::File));
                }
            }
        }
    }
    stems.sort_unstable();
    let (mut posed, mut without_pose, mut damaged) = (Vec::new(), Vec::new(), Damaged::default());
    for stem in stems {
        let path = dir.join(POSES).join(format!("{stem}.txt"));
        let (image_path, extension) = existing(&photos.join(&stem));
        let name = format!("{stem}{extension}");
        match read_matrix(&path)? {
            Matrix::Known(rows) => match affine_from_rows(&rows, DMat3::IDENTITY) {
                Ok(world_from_camera) => posed.push((name, image_path, world_from_camera.inverse())),
                Err(problem) => damaged.add(&name, problem, &path, Place::File),
            },
            Matrix::Lost => without_pose.push(name),
            // Any fault of a frame's own file counts as a fault of its pose.
            Matrix::Damaged(problem, place) => damaged.add(&name, problem, &path, place),
        }
    }
    if posed.is_empty() {
        return view_set(&dir.join(POSES), Vec::new(), PoseSource::Scannet, damaged);
    }
    // All photos have the size of the first readable one.
    let Some(size_px) = posed.iter().find_map(|(_, path, _)| photo::size_px(path)) else {
        let (n, folder) = (posed.len(), photos.display());
        let fault = format!(
            "no image of the {n} posed frames can be read in {folder}, and their size is stated nowhere else"
        );
        let problem = PoseProblem::new(fault, "give their folder with --images");
        return Err(problem.at(&intrinsics_path, Place::File));
    };
    let intrinsics =
        intrinsics(&camera, size_px).map_err(|problem| problem.at(&intrinsics_path, Place::File))?;
    let view =
        |(name, image_path, camera_from_world)| View { name, image_path, intrinsics, camera_from_world };
    let views = posed.into_iter().map(view).collect();
    Ok(ViewSet { without_pose, ..view_set(&dir.join(POSES), views, PoseSource::Scannet, damaged)? })
}

fn intrinsics(camera: &[Vec<f64>], (width_px, height_px): (u32, u32)) -> Result<Intrinsics, PoseProblem> {
    let (focal_px, centre_px) = ([camera[0][0], camera[1][1]], [camera[0][2], camera[1][2]]);
    let size = [width_px, height_px];
    let found = check_intrinsics(size.map(f64::from), focal_px, centre_px, Distortion::None)?;
    let is_off = |axis: usize| (centre_px[axis] / f64::from(size[axis]) - 0.5).abs() > MAX_OFF_CENTRE;
    if is_off(0) || is_off(1) {
        let [x, y] = centre_px;
        let fault = format!(
            "the principal point ({x}, {y}) px is far from the middle of images of {width_px} x {height_px} px; the \
             intrinsics belong to another image size"
        );
        return Err(PoseProblem::new(fault, "export the images in the size of the intrinsics"));
    }
    Ok(found)
}

fn read_matrix(path: &Path) -> io::Result<Matrix> {
    let file = File::open(path)?;
    let mut bytes = Vec::new();
    file.take(MAX_MATRIX_BYTES + 1).read_to_end(&mut bytes)?;
    let damaged = |problem| Ok(Matrix::Damaged(problem, Place::File));
    if bytes.len() as u64 > MAX_MATRIX_BYTES {
        let bytes = files::metadata(path)?.len();
        let expected = "the text of one 4 x 4 matrix";
        return damaged(PoseProblem::too_large(bytes, MAX_MATRIX_BYTES, expected));
    }
    let text = match files::text_of(&bytes) {
        Ok(text) => text,
        Err(fault) => return damaged(fault.into()),
    };
    let mut rows = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let mut row = Vec::new();
        for word in line.split_whitespace() {
            match word.parse::<f64>() {
                Ok(value) => row.push(value),
                Err(_) => {
                    let problem =
                        PoseProblem::expected("a number", word.chars().take(40).collect::<String>());
                    return Ok(Matrix::Damaged(problem, Place::Line(index as u64 + 1)));
                }
            }
        }
        if !row.is_empty() {
            rows.push(row);
        }
    }
    if !matches!(rows.len(), 3 | 4) || rows.iter().any(|row| row.len() != 4) {
        let found =
            format!("{} rows of {:?} numbers", rows.len(), rows.iter().map(Vec::len).collect::<Vec<_>>());
        let found: String = found.chars().take(60).collect();
        return damaged(PoseProblem::expected("4 rows of 4 numbers", found));
    }
    let lost = rows.iter().flatten().any(|value| *value == f64::NEG_INFINITY);
    Ok(if lost { Matrix::Lost } else { Matrix::Known(rows) })
}
