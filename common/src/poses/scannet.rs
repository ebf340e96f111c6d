//! Scene folders as ScanNet's SensReader exports them (Dai et al. 2017).
//!
//! ```text
//! SCENE/color/0.jpg                       photos
//! SCENE/pose/0.txt                        world from camera, 4 x 4, OpenCV axes, metres; -inf where tracking was lost
//! SCENE/intrinsic/intrinsic_color.txt     camera matrix, 4 x 4, of photos in their full size
//! ```
//!
//! `extrinsic_color.txt` and depth images are not read; nerfstudio's ScanNet dataparser does not read them either.

use std::io::Read;
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
}

pub(super) fn read(dir: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    let photos = images_dir.map_or_else(|| dir.join(PHOTOS), Path::to_owned);
    let intrinsics_path = dir.join(INTRINSICS);
    let Matrix::Known(camera) = read_matrix(&intrinsics_path)? else {
        let found = "-inf".to_owned();
        return Err(
            PoseProblem::Expected { expected: "a camera matrix", found }.at(&intrinsics_path, Place::File)
        );
    };
    let mut stems = Vec::new();
    for entry in fs_err::read_dir(dir.join(POSES))? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "txt") {
            match path.file_stem().and_then(|stem| stem.to_str()) {
                Some(stem) => stems.push(stem.to_owned()),
                None => {
                    let image = path.display().to_string();
                    return Err(PoseProblem::UnsafeName { image }.at(&path, Place::File));
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
        // Any fault of a frame's own file counts as a fault of its pose.
        let rows = match read_matrix(&path) {
            Ok(Matrix::Known(rows)) => rows,
            Ok(Matrix::Lost) => {
                without_pose.push(name);
                continue;
            }
            Err(PoseError::Invalid { path, place, problem }) => {
                damaged.add(&name, problem, &path, place);
                continue;
            }
            Err(other) => return Err(other),
        };
        match affine_from_rows(&name, &rows, DMat3::IDENTITY) {
            Ok(world_from_camera) => posed.push((name, image_path, world_from_camera.inverse())),
            Err(problem) => damaged.add(&name, problem, &path, Place::File),
        }
    }
    if posed.is_empty() {
        return view_set(&dir.join(POSES), Vec::new(), PoseSource::Scannet, damaged);
    }
    // All photos have the size of the first readable one.
    let Some(size_px) = posed.iter().find_map(|(_, path, _)| photo::size_px(path)) else {
        let problem = PoseProblem::NoImageSize { n_poses: posed.len(), folder: photos };
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
        return Err(PoseProblem::OtherImageSize { centre_px, size_px: size });
    }
    Ok(found)
}

fn read_matrix(path: &Path) -> Result<Matrix, PoseError> {
    let file = File::open(path)?;
    let mut bytes = Vec::new();
    file.take(MAX_MATRIX_BYTES + 1).read_to_end(&mut bytes)?;
    let fail = |problem: PoseProblem, place| Err(problem.at(path, place));
    if bytes.len() as u64 > MAX_MATRIX_BYTES {
        let bytes = files::metadata(path)?.len();
        let expected = "the text of one 4 x 4 matrix";
        return fail(PoseProblem::TooLarge { bytes, most: MAX_MATRIX_BYTES, expected }, Place::File);
    }
    let text = match files::text_of(&bytes) {
        Ok(text) => text,
        Err(fault) => return fail(PoseProblem::NotUtf8(fault), Place::File),
    };
    let mut rows = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let mut row = Vec::new();
        for word in line.split_whitespace() {
            match word.parse::<f64>() {
                Ok(value) => row.push(value),
                Err(_) => {
                    let found = word.chars().take(40).collect();
                    let problem = PoseProblem::Expected { expected: "a number", found };
                    return fail(problem, Place::Line(index as u64 + 1));
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
        let found = found.chars().take(60).collect();
        return fail(PoseProblem::Expected { expected: "4 rows of 4 numbers", found }, Place::File);
    }
    let lost = rows.iter().flatten().any(|value| *value == f64::NEG_INFINITY);
    Ok(if lost { Matrix::Lost } else { Matrix::Known(rows) })
}
