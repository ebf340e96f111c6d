//! COLMAP models: `cameras` and `images`, as text or binary. Sources: COLMAP's documentation, "Output Format", and
//! `src/colmap/sensor/models.h` for the numbers and parameters of the lens models.
//!
//! Points and 2D features are skipped without being stored.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Read};
use std::path::{Component, Path, PathBuf};

use fs_err::File;

use super::checks::{affine_from_wxyz, check_intrinsics};
use super::error::{Place, PoseError, PoseProblem};
use super::paths::{PhotoFinder, parent};
use super::view_set::{Damaged, PoseSource, ViewSet, view_set};
use crate::camera::{Distortion, Intrinsics, View};
use crate::files;

/// Longest image name read from a binary file, bytes: Linux's limit for a path.
const MAX_NAME_BYTES: u64 = 4096;
/// Bytes of a 2D feature in `images.bin`: x, y (f64) and a point id (u64).
const FEATURE_BYTES: u64 = 24;

/// The lens models: number, name, number of parameters.
const MODELS: [(i32, &str, usize); 11] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
];

/// A camera that cannot be used is an error only where an image uses it.
struct Cameras {
    path: PathBuf,
    of_id: BTreeMap<u32, (Place, Result<Intrinsics, PoseProblem>)>,
}

pub(super) fn read(
    model_dir: &Path,
    source: PoseSource,
    images_dir: Option<&Path>,
) -> Result<ViewSet, PoseError> {
    let images_dir = match images_dir {
        Some(dir) => dir.to_owned(),
        None => default_images_dir(model_dir)?,
    };
    let extension = if source == PoseSource::ColmapBinary { "bin" } else { "txt" };
    let [cameras_path, images_path] =
        ["cameras", "images"].map(|stem| model_dir.join(stem).with_extension(extension));
    let images = match source {
        PoseSource::ColmapBinary => {
            images_from_binary(&images_path, &cameras_from_binary(&cameras_path)?, &images_dir)?
        }
        _ => images_from_text(&images_path, &cameras_from_text(&cameras_path)?, &images_dir)?,
    };
    let mut set = view_set(&images_path, images.views, source, images.damaged)?;
    set.notes = notes(model_dir, extension, set.views.len());
    set.notes.extend(PhotoFinder::new(images_dir).find_missing(&mut set.views, &images.foreign));
    set.views.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(set)
}

/// Names what else could have been read: the model's other form, and larger models beside it.
fn notes(model_dir: &Path, extension: &str, n_views: usize) -> Vec<String> {
    let mut notes = Vec::new();
    let other = if extension == "bin" { "txt" } else { "bin" };
    let [own, other] = [extension, other].map(|extension| model_dir.join(format!("images.{extension}")));
    if other.is_file() {
        let changed = |path: &Path| fs_err::metadata(path).and_then(|metadata| metadata.modified()).ok();
        let newer = if changed(&other) > changed(&own) { ", which is newer," } else { "" };
        notes.push(format!(
            "read {}; {}{newer} is ignored: name the file to read it",
            own.display(),
            other.display()
        ));
    }
    let beside = model_dir.parent().map(models).unwrap_or_default();
    let others = beside.into_iter().filter(|(n, model)| *n > 0 && model != model_dir);
    if let Some((n, other)) = largest(others) {
        notes.push(format!(
            "{} has {n_views} images; {} beside it has {n}: COLMAP made several models, one is read",
            model_dir.display(),
            other.display()
        ));
    }
    notes
}

/// Returns the numbered COLMAP model (`0`, `1` ...) with the most images in a folder.
pub(super) fn largest_model(folder: &Path) -> Option<PathBuf> {
    largest(models(folder).into_iter()).map(|(_, model)| model)
}

fn largest(models: impl Iterator<Item = (u64, PathBuf)>) -> Option<(u64, PathBuf)> {
    models.reduce(|best, model| if model.0 > best.0 { model } else { best })
}

/// Returns the numbered models of a folder and how many images each has, by number.
fn models(folder: &Path) -> Vec<(u64, PathBuf)> {
    let number = |path: &PathBuf| path.file_name()?.to_str()?.parse::<u32>().ok();
    let entries = fs_err::read_dir(folder).into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
    let mut models: Vec<(u32, PathBuf)> = entries.filter_map(|path| Some((number(&path)?, path))).collect();
    models.sort();
    models.into_iter().filter_map(|(_, path)| Some((n_images(&path)?, path))).collect()
}

/// Returns the number of images that a model states or, as text, suggests by its lines; `None` without a model.
fn n_images(model_dir: &Path) -> Option<u64> {
    if let Ok(mut file) = Binary::open(&model_dir.join("images.bin")) {
        return file.u64("the number of images").ok();
    }
    let mut lines = Lines::open(&model_dir.join("images.txt")).ok()?;
    let mut n = 0;
    while lines.advance_to_record().ok()? {
        n += u64::from(!is_features(&lines.line));
    }
    Some(n)
}

/// Returns the first folder that exists, else the first: `images/` beside a parent folder `sparse`, beside the
/// model's folder, in the model's folder.
fn default_images_dir(model_dir: &Path) -> Result<PathBuf, PoseError> {
    let beside = parent(model_dir)?;
    let mut candidates = vec![beside.join("images"), model_dir.join("images")];
    if beside.file_name().is_some_and(|name| name == "sparse") {
        candidates.insert(0, parent(&beside)?.join("images"));
    }
    let found = candidates.iter().position(|dir| dir.is_dir()).unwrap_or(0);
    Ok(candidates.swap_remove(found))
}

fn unsupported(camera_id: u32, model: &str) -> PoseProblem {
    let fault = format!("camera {camera_id}: model {model} is not supported");
    PoseProblem::new(fault, "run COLMAP's image_undistorter and use its output")
}

/// Returns the intrinsics of a camera; `params` has COLMAP's order.
fn intrinsics(
    camera_id: u32,
    model: &str,
    size_px: [f64; 2],
    params: &[f64],
) -> Result<Intrinsics, PoseProblem> {
    let brown = |k1, k2, p| Distortion::Brown { k: [k1, k2, 0.0], p };
    let (focal, centre, distortion) = match (model, params) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], brown(k, 0.0, [0.0; 2])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], brown(k1, k2, [0.0; 2])),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], brown(k1, k2, [p1, p2])),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ([fx, fy], [cx, cy], Distortion::Fisheye { k: [k1, k2, k3, k4] })
        }
        _ => {
            let model = excerpt(model);
            return Err(match MODELS.iter().find(|(_, name, _)| *name == model) {
                Some(&(.., expected)) if expected != params.len() => {
                    let fault = format!("{model} has {expected} parameters, found {}", params.len());
                    PoseProblem::new(fault, "export the cameras again")
                }
                _ => unsupported(camera_id, &model),
            });
        }
    };
    check_intrinsics(size_px, focal, centre, distortion)
}

/// What a model's images refer to.
struct Model<'a> {
    cameras: &'a Cameras,
    images_dir: &'a Path,
    /// The file with the images, for errors.
    path: &'a Path,
}

struct Record<'a> {
    name: &'a str,
    camera_id: u32,
    wxyz: [f64; 4],
    translation: [f64; 3],
    place: Place,
}

#[derive(Default)]
struct Images {
    views: Vec<View>,
    /// Images without a pose.
    damaged: Damaged,
    /// Names that were paths of another machine: absolute, or above the image folder.
    foreign: BTreeSet<String>,
}

impl Images {
    /// Adds an image record. Leaves out records without a pose (zeros, NaN), which some exporters write for photos
    /// that they could not place, and those with an invalid one.
    fn push(&mut self, model: &Model<'_>, record: Record<'_>) -> Result<(), PoseError> {
        let Record { camera_id, wxyz, translation, place, .. } = record;
        if wxyz == [0.0; 4] || wxyz.iter().any(|q| q.is_nan()) {
            self.damaged.add_unplaced(record.name.trim(), format!("its quaternion is {wxyz:?}"));
            return Ok(());
        }
        let (name, is_foreign) = relative(record.name);
        let is_inside = |path: &Path| path.components().all(|c| matches!(c, Component::Normal(_)));
        if name.is_empty() || name.contains('\0') || !is_inside(Path::new(&name)) {
            return Err(PoseProblem::unsafe_name(&name).at(model.path, place));
        }
        let intrinsics = match model.cameras.of_id.get(&camera_id) {
            Some((_, Ok(intrinsics))) => *intrinsics,
            Some((place, Err(problem))) => return Err(problem.clone().at(&model.cameras.path, *place)),
            None => {
                let fault =
                    format!("image {name:?} uses camera {camera_id}, which is not in the cameras file");
                return Err(PoseProblem::new(fault, "export both files together").at(model.path, place));
            }
        };
        match affine_from_wxyz(wxyz, translation) {
            Err(problem) => self.damaged.add(&name, problem, model.path, place),
            Ok(camera_from_world) => {
                if is_foreign {
                    self.foreign.insert(name.clone());
                }
                let image_path = model.images_dir.join(&name);
                self.views.push(View { image_path, camera_from_world, name, intrinsics });
            }
        }
        Ok(())
    }
}

/// Returns an image's name as a path inside the image folder, and whether it was a path of another machine.
fn relative(name: &str) -> (String, bool) {
    let name = name.replace('\\', "/");
    let mut inside = name.strip_prefix("./").unwrap_or(&name);
    let mut is_foreign = matches!(name.as_bytes(), [drive, b':', b'/', ..] if drive.is_ascii_alphabetic());
    while let Some(rest) = ["/", "../", "./"].iter().find_map(|start| inside.strip_prefix(start)) {
        (inside, is_foreign) = (rest, true);
    }
    (inside.to_owned(), is_foreign)
}

impl Cameras {
    fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), of_id: BTreeMap::new() }
    }

    fn insert(
        &mut self,
        camera_id: u32,
        place: Place,
        camera: Result<Intrinsics, PoseProblem>,
    ) -> Result<(), PoseError> {
        match self.of_id.insert(camera_id, (place, camera)) {
            None => Ok(()),
            Some(_) => {
                let fault = format!("two cameras have the id {camera_id}");
                Err(PoseProblem::new(fault, "remove one of them").at(&self.path, place))
            }
        }
    }
}

struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    line: String,
    number: u64,
}

impl Lines {
    fn open(path: &Path) -> Result<Self, PoseError> {
        let reader = BufReader::new(File::open(path)?);
        Ok(Self { path: path.to_owned(), reader, line: String::new(), number: 0 })
    }

    fn fail(&self, problem: PoseProblem) -> PoseError {
        problem.at(&self.path, Place::Line(self.number))
    }

    /// Reads the next line; returns `false` at the end of the file.
    fn advance(&mut self) -> Result<bool, PoseError> {
        let mut bytes = std::mem::take(&mut self.line).into_bytes();
        bytes.clear();
        self.number += 1;
        let n = self.reader.read_until(b'\n', &mut bytes)?;
        let text = files::text_of(&bytes).map(str::to_owned);
        self.line = text.map_err(|stranger| self.fail(stranger.into()))?;
        Ok(n > 0)
    }

    /// Reads up to the next line that is neither empty nor a comment; returns `false` at the end of the file.
    fn advance_to_record(&mut self) -> Result<bool, PoseError> {
        while self.advance()? {
            let line = self.line.trim();
            if !line.is_empty() && !line.starts_with('#') {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

fn take<T: std::str::FromStr>(rest: &mut &str, expected: &'static str) -> Result<T, PoseProblem> {
    let trimmed = rest.trim_start();
    let (word, after) = trimmed.split_at(trimmed.find(char::is_whitespace).unwrap_or(trimmed.len()));
    *rest = after;
    word.parse().map_err(|_| PoseProblem::expected(expected, excerpt(word)))
}

fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}

fn take_numbers<const N: usize>(rest: &mut &str, expected: &'static str) -> Result<[f64; N], PoseProblem> {
    let mut numbers = [0.0; N];
    for number in &mut numbers {
        *number = take(rest, expected)?;
    }
    Ok(numbers)
}

fn cameras_from_text(path: &Path) -> Result<Cameras, PoseError> {
    let mut cameras = Cameras::new(path);
    let mut lines = Lines::open(path)?;
    while lines.advance_to_record()? {
        let mut rest = lines.line.as_str();
        let camera_id = take(&mut rest, "a camera id").map_err(|problem| lines.fail(problem))?;
        cameras.insert(camera_id, Place::Line(lines.number), camera_from_words(camera_id, rest))?;
    }
    Ok(cameras)
}

fn camera_from_words(camera_id: u32, mut rest: &str) -> Result<Intrinsics, PoseProblem> {
    let model: String = take(&mut rest, "a lens model")?;
    let size_px = take_numbers::<2>(&mut rest, "width and height in pixels")?;
    let mut params = Vec::new();
    while !rest.trim_start().is_empty() {
        params.push(take(&mut rest, "a lens parameter")?);
    }
    intrinsics(camera_id, &model, size_px, &params)
}

fn images_from_text(path: &Path, cameras: &Cameras, images_dir: &Path) -> Result<Images, PoseError> {
    let (model, mut images) = (Model { cameras, images_dir, path }, Images::default());
    let mut lines = Lines::open(path)?;
    let mut has_record = lines.advance_to_record()?;
    while has_record {
        let place = Place::Line(lines.number);
        let record = record_of_line(&lines.line, place).map_err(|problem| lines.fail(problem))?;
        images.push(&model, record)?;
        // A line of features follows each image, perhaps empty; some exporters omit it.
        has_record = lines.advance()?;
        if has_record && is_features(&lines.line) {
            has_record = lines.advance_to_record()?;
        }
    }
    Ok(images)
}

/// Returns whether a line has the 2D features of an image, `X Y POINT3D_ID` each, or is empty or a comment.
fn is_features(line: &str) -> bool {
    let is_number = |word: &str| word.parse::<f64>().is_ok();
    line.starts_with('#')
        || line.split_whitespace().count().is_multiple_of(3) && line.split_whitespace().all(is_number)
}

fn record_of_line(line: &str, place: Place) -> Result<Record<'_>, PoseProblem> {
    let mut rest = line;
    let _image_id: u32 =
        take(&mut rest, "an image id, or the 2D features (X Y POINT3D_ID ...) of the image before")?;
    let wxyz = take_numbers(&mut rest, "a quaternion QW QX QY QZ")?;
    let translation = take_numbers(&mut rest, "a translation TX TY TZ")?;
    let camera_id = take(&mut rest, "a camera id")?;
    Ok(Record { name: rest.trim(), camera_id, wxyz, translation, place })
}

/// Counts in the file are checked against its length.
struct Binary {
    path: PathBuf,
    reader: BufReader<File>,
    offset_bytes: u64,
    len_bytes: u64,
}

impl Binary {
    fn open(path: &Path) -> Result<Self, PoseError> {
        let file = File::open(path)?;
        let len_bytes = file.metadata()?.len();
        Ok(Self { path: path.to_owned(), reader: BufReader::new(file), offset_bytes: 0, len_bytes })
    }

    fn fail(&self, problem: PoseProblem) -> PoseError {
        problem.at(&self.path, Place::Byte(self.offset_bytes))
    }

    fn take<const N: usize>(&mut self, expected: &'static str) -> Result<[u8; N], PoseError> {
        let mut bytes = [0; N];
        if self.len_bytes.saturating_sub(self.offset_bytes) < N as u64 {
            return Err(self.fail(PoseProblem::truncated(expected)));
        }
        self.reader.read_exact(&mut bytes)?;
        self.offset_bytes += N as u64;
        Ok(bytes)
    }

    fn u32(&mut self, expected: &'static str) -> Result<u32, PoseError> {
        Ok(u32::from_le_bytes(self.take(expected)?))
    }

    fn u64(&mut self, expected: &'static str) -> Result<u64, PoseError> {
        Ok(u64::from_le_bytes(self.take(expected)?))
    }

    fn numbers<const N: usize>(&mut self, expected: &'static str) -> Result<[f64; N], PoseError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take(expected)?);
        }
        Ok(numbers)
    }

    /// Reads a text terminated by a zero byte.
    fn name(&mut self) -> Result<String, PoseError> {
        let mut bytes = Vec::new();
        self.reader.by_ref().take(MAX_NAME_BYTES).read_until(0, &mut bytes)?;
        let expected = "an image name of at most 4096 bytes, terminated by a zero byte";
        if bytes.last() != Some(&0) {
            return Err(self.fail(PoseProblem::truncated(expected)));
        }
        bytes.pop();
        let name = String::from_utf8(bytes).map_err(|e| {
            let found = excerpt(&String::from_utf8_lossy(e.as_bytes()));
            self.fail(PoseProblem::expected(expected, found))
        })?;
        self.offset_bytes += name.len() as u64 + 1;
        Ok(name)
    }

    /// Skips `count` records, after checking that the file holds them.
    fn skip(&mut self, count: u64, record_bytes: u64, expected: &'static str) -> Result<(), PoseError> {
        let left = self.len_bytes.saturating_sub(self.offset_bytes);
        match count.checked_mul(record_bytes) {
            Some(bytes) if bytes <= left => {
                // At most the file's length, which fits an i64.
                self.reader.seek_relative(bytes as i64)?;
                self.offset_bytes += bytes;
                Ok(())
            }
            _ => Err(self.fail(PoseProblem::truncated(expected))),
        }
    }

    fn expect_end(&self) -> Result<(), PoseError> {
        if self.offset_bytes == self.len_bytes {
            return Ok(());
        }
        let found = format!("{} more bytes", self.len_bytes.saturating_sub(self.offset_bytes));
        Err(self.fail(PoseProblem::expected("the end of the file", found)))
    }
}

fn cameras_from_binary(path: &Path) -> Result<Cameras, PoseError> {
    let mut cameras = Cameras::new(path);
    let mut file = Binary::open(path)?;
    for _ in 0..file.u64("the number of cameras")? {
        let camera_id = file.u32("a camera id")?;
        let model_id = i32::from_le_bytes(file.take("a lens model's number")?);
        let Some((_, model, n_params)) = MODELS.iter().find(|(id, ..)| *id == model_id) else {
            return Err(file.fail(unsupported(camera_id, &format!("number {model_id}"))));
        };
        let size_px = [file.u64("the width")? as f64, file.u64("the height")? as f64];
        let mut params = Vec::new();
        for _ in 0..*n_params {
            params.push(f64::from_le_bytes(file.take("a lens parameter")?));
        }
        let camera = intrinsics(camera_id, model, size_px, &params);
        cameras.insert(camera_id, Place::Byte(file.offset_bytes), camera)?;
    }
    file.expect_end()?;
    Ok(cameras)
}

fn images_from_binary(path: &Path, cameras: &Cameras, images_dir: &Path) -> Result<Images, PoseError> {
    let (model, mut images) = (Model { cameras, images_dir, path }, Images::default());
    let mut file = Binary::open(path)?;
    for _ in 0..file.u64("the number of images")? {
        let _image_id = file.u32("an image id")?;
        let wxyz = file.numbers("a quaternion")?;
        let translation = file.numbers("a translation")?;
        let camera_id = file.u32("a camera id")?;
        let name = file.name()?;
        let place = Place::Byte(file.offset_bytes);
        images.push(&model, Record { name: &name, camera_id, wxyz, translation, place })?;
        let n_features = file.u64("the number of 2D features")?;
        file.skip(n_features, FEATURE_BYTES, "the image's 2D features")?;
    }
    file.expect_end()?;
    Ok(images)
}
