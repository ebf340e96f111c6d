//! Nerfstudio's `transforms.json` (its documentation, "Data conventions").
//!
//! `transform_matrix` is world from camera in OpenGL axes (x right, y up, z backward). An `applied_transform`
//! records an earlier change of the world frame; it is not undone, so the world frame is that of the file's poses.

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec3};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::checks::{affine_from_rows, check_intrinsics};
use super::error::{Place, PoseError, PoseProblem};
use super::paths::{PhotoFinder, Stated, parent, parts_of, settle};
use super::view_set::{AppliedTransform, Damaged, PoseSource, ViewSet, view_set};
use crate::camera::{Distortion, Intrinsics, View};
use crate::{files, photo};

/// Largest ratio between a stated focal length and that of a stated angle, if they agree.
const MAX_FOCAL_RATIO: f64 = 1.02;

/// Extensions tried, in this order, for a `file_path` without one.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "webp", "PNG", "JPG"];

/// Camera keys of a frame, or those at the top of the file, which are the defaults.
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
    k5: Option<f64>,
    k6: Option<f64>,
    b1: Option<f64>,
    b2: Option<f64>,
    /// k1, k2, k3, k4, p1, p2; goes before these (`nerfstudio_dataparser.py`).
    distortion_params: Option<Vec<f64>>,
}

/// An element of `frames`.
#[derive(Deserialize)]
struct FrameEntry {
    file_path: String,
    /// NaN, which is not JSON, was replaced by null. `None`: the frame was not placed.
    transform_matrix: Option<Vec<Vec<Option<f64>>>>,
    mask_path: Option<IgnoredAny>,
    #[serde(flatten)]
    camera: Camera,
}

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    camera: Camera,
    frames: Vec<FrameEntry>,
    applied_transform: Option<Vec<Vec<f64>>>,
    applied_scale: Option<f64>,
}

pub(super) fn read(path: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    let bytes = files::read(path)?;
    let in_file = |problem: PoseProblem| problem.at(path, Place::File);
    let text = files::text_of(&bytes).map_err(|fault| in_file(fault.into()))?;
    let text = null_for_nan(text.as_bytes());
    if text.trim_ascii_start().starts_with(b"[") {
        let fault = "this is a list, as the cameras.json of a training run, not a transforms.json";
        let advice = "give the COLMAP model that the splat was trained from, or a transforms.json";
        return Err(in_file(PoseProblem::new(fault, advice)));
    }
    let transforms: Transforms = serde_json::from_slice(&text).map_err(|cause| {
        PoseError::of(path, format_args!("{cause}; export the file again with nerfstudio"))
    })?;
    let folder = parent(path)?;
    let mut frames = Frames {
        paths: transforms.frames.iter().map(|frame| frame.file_path.replace('\\', "/")).collect(),
        images_dir,
        folder: &folder,
        finders: match images_dir {
            Some(dir) => vec![PhotoFinder::new(dir.to_owned())],
            None => vec![PhotoFinder::new(folder.clone()), PhotoFinder::new(folder.join("images"))],
        },
    };
    let names = names_of(&frames.paths);
    let (mut views, mut stated, mut damaged) = (Vec::new(), Vec::new(), Damaged::default());
    for (index, (frame, name)) in transforms.frames.iter().zip(names).enumerate() {
        let place = Place::Frame(index);
        let image = frames.paths[index].clone();
        let world_from_camera = match world_from_camera(frame) {
            Ok(found) => found,
            Err(problem) => {
                damaged.add(name.as_deref().unwrap_or(&image), problem, path, place);
                continue;
            }
        };
        let photo = frames.photo(index, name);
        let photo = photo.ok_or_else(|| PoseProblem::unsafe_name(&image).at(path, place))?;
        let FramePhoto { name, image_path, elsewhere } = photo;
        let camera = frame.camera.clone().or(&transforms.camera);
        let Some(size_px) = camera.size_px(&image_path) else {
            let photo = image_path.display();
            let fault = format!(
                "its size is unknown: neither the frame nor the top of the file has w and h, and {photo} cannot be read"
            );
            let advice = "add them, or give the photos' folder with --images";
            damaged.add(&name, PoseProblem::new(fault, advice), path, place);
            continue;
        };
        let intrinsics = camera.intrinsics(size_px).map_err(|problem| problem.at(path, place))?;
        views.push(View { name, image_path, intrinsics, camera_from_world: world_from_camera.inverse() });
        stated.push(elsewhere);
    }
    let moved = |n: usize, first: &str| format!("{n} photos are not where the file says; found {first}");
    let mut notes = settle(&mut views, stated, moved);
    notes.extend(not_read(&transforms, &views));
    let applied = applied(&transforms, &folder).map_err(in_file)?;
    Ok(ViewSet { applied, notes, ..view_set(path, views, PoseSource::Transforms, damaged)? })
}

/// Reports entries of the file that have no effect.
fn not_read(transforms: &Transforms, views: &[View]) -> Vec<String> {
    let mut found = Vec::new();
    let n_masked = transforms.frames.iter().filter(|frame| frame.mask_path.is_some()).count();
    if n_masked > 0 {
        found.push(format!(
            "{n_masked} frames have a mask_path, which is not read; make transparent in the photos what they hide"
        ));
    }
    let camera = &transforms.camera;
    let width_px = camera.w.or(views.first().map(|view| view.intrinsics.width_px.into()));
    if let (Some(angle), Some(stated_px), Some(width_px)) = (camera.camera_angle_x, camera.fl_x, width_px) {
        let by_angle_px = 0.5 * width_px / (0.5 * angle).tan();
        if !(1.0 / MAX_FOCAL_RATIO..=MAX_FOCAL_RATIO).contains(&(by_angle_px / stated_px)) {
            found.push(format!(
                "camera_angle_x means a focal length of {by_angle_px:.1} px, fl_x says {stated_px:.1} px; fl_x is taken"
            ));
        }
    }
    found
}

fn world_from_camera(frame: &FrameEntry) -> Result<DAffine3, PoseProblem> {
    let missing = |found| PoseProblem::expected("a transform_matrix of finite numbers", found);
    let matrix = frame.transform_matrix.as_ref().ok_or_else(|| missing("none"))?;
    let rows = finite(matrix).ok_or_else(|| missing("null or NaN"))?;
    let opencv_axes_in_opengl = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    affine_from_rows(&rows, opencv_axes_in_opengl)
}

/// Replaces NaN and infinities, which some writers put into JSON, with null.
fn null_for_nan(json: &[u8]) -> Vec<u8> {
    let (mut out, mut rest, mut is_text) = (Vec::with_capacity(json.len() + 16), json, false);
    while let [byte, after @ ..] = rest {
        let word = [&b"-Infinity"[..], b"Infinity", b"NaN"].into_iter().find(|word| rest.starts_with(word));
        if let (false, Some(word)) = (is_text, word) {
            out.extend_from_slice(b"null");
            rest = &rest[word.len()..];
            continue;
        }
        is_text ^= *byte == b'"';
        let n = if is_text && *byte == b'\\' { rest.len().min(2) } else { 1 };
        out.extend_from_slice(&rest[..n]);
        rest = if n == 1 { after } else { &rest[n..] };
    }
    out
}

fn finite(rows: &[Vec<Option<f64>>]) -> Option<Vec<Vec<f64>>> {
    rows.iter().map(|row| row.iter().copied().collect()).collect()
}

struct Frames<'a> {
    paths: Vec<String>,
    images_dir: Option<&'a Path>,
    folder: &'a Path,
    finders: Vec<PhotoFinder>,
}

struct FramePhoto {
    name: String,
    image_path: PathBuf,
    /// What the file says, if the photo was found elsewhere.
    elsewhere: Option<Stated>,
}

impl Frames<'_> {
    /// Returns the path and the name of a frame's photo: as stated, or at the longest suffix of that path that
    /// exists. `name`: as stated, perhaps without an extension.
    fn photo(&mut self, index: usize, name: Option<String>) -> Option<FramePhoto> {
        let (name, file_path) = (name?, &self.paths[index]);
        let (image_path, ending) = match self.images_dir {
            Some(dir) => existing(&dir.join(&name)),
            None => existing(&self.folder.join(file_path)),
        };
        let name = name + &ending;
        if !image_path.is_file()
            && let Some((found, ending)) = self.finders.iter_mut().find_map(|finder| finder.find(file_path))
        {
            let stated = Stated { image_path, name, said: file_path.clone() };
            return Some(FramePhoto { name: ending, image_path: found, elsewhere: Some(stated) });
        }
        Some(FramePhoto { name, image_path, elsewhere: None })
    }
}

/// Returns the earlier change of the world frame. Old versions of nerfstudio do not record it and assume
/// [`COLMAP_AXES`] where the folder has `colmap/sparse/0` (`nerfstudio_dataparser.py`).
fn applied(transforms: &Transforms, folder: &Path) -> Result<Option<AppliedTransform>, PoseProblem> {
    let scale = transforms.applied_scale.unwrap_or(1.0);
    if !(scale.is_finite() && scale > 0.0) {
        return Err(PoseProblem::expected("an applied_scale above 0", scale));
    }
    let transform = match &transforms.applied_transform {
        Some(rows) => affine_from_rows(rows, DMat3::IDENTITY)?,
        None if folder.join("colmap/sparse/0").is_dir() => DAffine3::from_mat3(COLMAP_AXES),
        None if transforms.applied_scale.is_some() => DAffine3::IDENTITY,
        None => return Ok(None),
    };
    Ok(Some(AppliedTransform { transform, scale }))
}

/// Nerfstudio's world axes from COLMAP's and ScanNet's: x and y swapped, z negated.
pub(super) const COLMAP_AXES: DMat3 =
    DMat3::from_cols(DVec3::new(0.0, 1.0, 0.0), DVec3::new(1.0, 0.0, 0.0), DVec3::new(0.0, 0.0, -1.0));

/// Returns the name of each image: its path relative to the image folder; `None` if it has none.
///
/// The image folder is the first one called `images` or `images_N` (nerfstudio's downscaled copies), so that names
/// agree with COLMAP's. If several image folders differ (`left/images`, `right/images`), names are relative to their
/// common parent. A path without an image folder is its name.
fn names_of(file_paths: &[String]) -> Vec<Option<String>> {
    let split: Vec<(Vec<&str>, usize)> = file_paths
        .iter()
        .map(|path| {
            let parts = parts_of(path);
            let folders = &parts[..parts.len().saturating_sub(1)];
            let images_at = folders.iter().position(|part| is_image_folder(part));
            (parts, images_at.map_or(0, |at| at + 1))
        })
        .collect();
    let mut parents = split.iter().map(|(parts, start)| &parts[..start.saturating_sub(1)]);
    let first = parents.next().unwrap_or_default();
    let (mut n_common, mut all_equal) = (first.len(), true);
    for parent in parents {
        n_common = first.iter().zip(parent).take(n_common).take_while(|(a, b)| a == b).count();
        all_equal &= parent == first;
    }
    let name = |(parts, start): &(Vec<&str>, usize)| {
        let name = parts.get(if all_equal { *start } else { n_common }..)?.join("/");
        (!name.is_empty() && !name.contains('\0')).then_some(name)
    };
    split.iter().map(name).collect()
}

fn is_image_folder(name: &str) -> bool {
    let is_number = |n: &str| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit());
    name.strip_prefix("images")
        .is_some_and(|rest| rest.is_empty() || rest.strip_prefix('_').is_some_and(is_number))
}

/// Returns the path or, without an image extension, the first existing path with one; and the text added.
pub(super) fn existing(path: &Path) -> (PathBuf, String) {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    if EXTENSIONS.iter().any(|e| e.eq_ignore_ascii_case(extension)) || path.is_file() {
        return (path.to_owned(), String::new());
    }
    for extension in EXTENSIONS {
        // Append, do not replace: the extension of `frame.0001` is a number.
        let mut longer = path.as_os_str().to_owned();
        longer.push(format!(".{extension}"));
        if Path::new(&longer).is_file() {
            return (longer.into(), format!(".{extension}"));
        }
    }
    (path.to_owned(), String::new())
}

impl Camera {
    /// Fills missing keys from `shared`.
    fn or(self, shared: &Self) -> Self {
        // A frame's own angle takes precedence over a shared focal length.
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
            k5: self.k5.or(shared.k5),
            k6: self.k6.or(shared.k6),
            b1: self.b1.or(shared.b1),
            b2: self.b2.or(shared.b2),
            distortion_params: self.distortion_params.clone().or_else(|| shared.distortion_params.clone()),
        }
    }

    /// NeRF's first data sets state the size only in the images.
    fn size_px(&self, image_path: &Path) -> Option<[f64; 2]> {
        let stated = self.w.zip(self.h).map(|(w, h)| [w, h]);
        stated.or_else(|| photo::size_px(image_path).map(|(w, h)| [w, h].map(f64::from)))
    }

    fn intrinsics(&self, [width_px, height_px]: [f64; 2]) -> Result<Intrinsics, PoseProblem> {
        let focal = |length: Option<f64>, angle: Option<f64>, side_px: f64| {
            length.or_else(|| angle.filter(|a| *a > 0.0 && *a < PI).map(|a| 0.5 * side_px / (0.5 * a).tan()))
        };
        let focal_x_px = focal(self.fl_x, self.camera_angle_x, width_px).ok_or_else(|| {
            let fault = "fl_x, or camera_angle_x within 0..pi radians, is missing, both in the frame and at the top of \
                         the file";
            PoseProblem::new(fault, "add it to one of them")
        })?;
        let focal_y_px = focal(self.fl_y, self.camera_angle_y, height_px).unwrap_or(focal_x_px);
        let centre_px = [self.cx.unwrap_or(0.5 * width_px), self.cy.unwrap_or(0.5 * height_px)];
        check_intrinsics([width_px, height_px], [focal_x_px, focal_y_px], centre_px, self.distortion()?)
    }

    /// Returns the lens distortion; as in nerfstudio, every perspective model may have coefficients.
    fn distortion(&self) -> Result<Distortion, PoseProblem> {
        let [k1, k2, k3, k4, p1, p2] = match &self.distortion_params {
            None => [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2].map(|c| c.unwrap_or(0.0)),
            Some(all) => <[f64; 6]>::try_from(&**all).map_err(|_| {
                let expected = "6 numbers in distortion_params: k1, k2, k3, k4, p1, p2";
                PoseProblem::expected(expected, all.len())
            })?,
        };
        // OpenCV's rational model, Metashape's affinity.
        let further = [(self.k5, "k5"), (self.k6, "k6"), (self.b1, "b1"), (self.b2, "b2")];
        let further = further.into_iter().find(|(value, _)| value.is_some_and(|value| value != 0.0));
        let fallback = if self.is_fisheye == Some(true) { "OPENCV_FISHEYE" } else { "OPENCV" };
        let unsupported = |model: &str, with: &str| {
            let model: String = format!("{model}{with}").chars().take(60).collect();
            let advice = "undistort the images or export with OPENCV";
            PoseProblem::new(format!("lens model {model} is not supported"), advice)
        };
        let model = self.camera_model.as_deref().unwrap_or(fallback);
        if let Some((_, key)) = further {
            return Err(unsupported(model, &format!(" with {key}")));
        }
        match model {
            "OPENCV_FISHEYE" => Ok(Distortion::Fisheye { k: [k1, k2, k3, k4] }),
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" if k4 == 0.0 => {
                Ok(Distortion::Brown { k: [k1, k2, k3], p: [p1, p2] })
            }
            model => Err(unsupported(model, if k4 == 0.0 { "" } else { " with k4" })),
        }
    }
}
