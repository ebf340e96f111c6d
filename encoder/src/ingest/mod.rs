//! Ingest: loads photos as ideal pinhole images of known size.

mod splat_frame;

use std::collections::BTreeMap;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, RgbImage};
use serde::Deserialize;
use slag_common::photo::{self, PhotoError};
use slag_common::{ByteSize, Distortion, Gaussians, Hash32, Intrinsics, View, files};

pub use splat_frame::{Activated, FrameChoice, GeoError, read_geo_reference, to_poses};
pub(crate) use splat_frame::{FoundFrame, find_frame};

/// Largest factor by which photos may be downscaled from the size in the intrinsics.
const MAX_DOWNSCALE: u32 = 64;
/// Largest factor by which they may be enlarged: more is a damaged header.
const MAX_UPSCALE: u64 = 8;
/// Peak bytes per pixel while a photo is loaded: eight as read (16 bits, transparent), three as colours; three without
/// distortion, which replace the first.
pub(crate) const LOADED_BYTES_PER_PX: u64 = 11;

#[derive(Clone, Debug)]
pub struct LoadedImage {
    /// With the size of the image and pinhole intrinsics.
    pub view: View,
    /// Black outside the lens image.
    pub image: RgbImage,
    /// The applied mapping, if the lens has distortion.
    pub undistorter: Option<Undistorter>,
    /// Opaque pixels inside the lens image, row-major; `None` if all are.
    pub valid: Option<Vec<bool>>,
    pub oddity: Option<Oddity>,
}

/// What is odd about a photo that is used all the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Oddity {
    /// An EXIF orientation was ignored: poses are computed from the pixels as stored.
    Rotated,
    /// Its lens model leaves less than half of its pixels.
    Narrowed,
}

/// Counts odd photos, and keeps the first one's name: a camera held upright makes thousands of them.
#[derive(Debug, Default)]
pub struct OddPhotos(Mutex<[(usize, String); 2]>);

impl OddPhotos {
    pub fn add(&self, photo: &LoadedImage) {
        let Some(oddity) = photo.oddity else { return };
        let (n, first) = &mut self.0.lock().unwrap_or_else(PoisonError::into_inner)[oddity as usize];
        *n += 1;
        if *n == 1 {
            first.clone_from(&photo.view.name);
        }
    }

    pub fn warn(&self) {
        self.lines().iter().for_each(|line| tracing::warn!("{line}"));
    }

    pub fn lines(&self) -> Vec<String> {
        let [rotated, narrowed] = &*self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let line = |(n, first): &(usize, String), rest: [&str; 2]| {
            (*n > 0).then(|| format!("{n} photos {}; the first is {first}. {}", rest[0], rest[1]))
        };
        let of_rotated = [
            "have an EXIF orientation, which is ignored",
            "If they fit badly, were their poses computed from rotated copies?",
        ];
        let of_narrowed = [
            "lose more than half of their pixels to their camera's lens model",
            "Are its distortion coefficients those of this lens?",
        ];
        [line(rotated, of_rotated), line(narrowed, of_narrowed)].into_iter().flatten().collect()
    }
}

#[derive(Debug, thiserror::Error)]
pub enum IngestError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    #[error("{}: {fault}", path.display())]
    Photo { path: PathBuf, fault: PhotoError },
    #[error("{}: {problem}", path.display())]
    File { path: PathBuf, problem: String },
    #[error(
        "{}: the image is {} x {} px but its camera {} x {} px, and {}",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1], size_advice(*found_px, *expected_px)
    )]
    Size { path: PathBuf, found_px: [u32; 2], expected_px: [u32; 2] },
}

fn size_advice(found_px: [u32; 2], expected_px: [u32; 2]) -> String {
    let area_px = |i: usize| u64::from(found_px[i]) * u64::from(expected_px[i]);
    if area_px(0) == area_px(1) {
        return "these are its sides swapped; swap the camera's width and height, or give photos that are not turned"
            .into();
    }
    format!(
        "the one is no uniform scale of the other, 1/{MAX_DOWNSCALE} to {MAX_UPSCALE}; give the images that the poses \
         were computed from, or whole-factor reductions of them"
    )
}

#[derive(Deserialize)]
struct Drawn {
    drawn_from: String,
}

/// The splat that a poses file's images were drawn from; `None` for photos. Only transforms.json of `plan` and `draw`
/// says so.
pub fn drawn_from(poses: &Path) -> Option<String> {
    let inside = poses.join("transforms.json");
    let path = if poses.is_dir() { &inside } else { poses };
    let is_json = path.extension().is_some_and(|extension| extension == "json");
    let bytes = is_json.then(|| fs_err::read(path).ok())??;
    // The reader of poses reports malformed files.
    serde_json::from_str::<Drawn>(files::text_of(&bytes).ok()?).ok().map(|drawn| drawn.drawn_from)
}

/// Number of views whose image is a drawing: it lies in the `images/` beside a poses file of `plan` or `draw`.
pub(crate) fn n_drawn<'a>(views: impl IntoIterator<Item = &'a View>) -> usize {
    let mut is_drawn_in: BTreeMap<&'a Path, bool> = BTreeMap::new();
    let mut is_drawn = |view: &&'a View| {
        let images = view.image_path.ancestors().find(|path| path.ends_with("images"));
        let folder = images.and_then(Path::parent);
        folder
            .is_some_and(|folder| *is_drawn_in.entry(folder).or_insert_with(|| drawn_from(folder).is_some()))
    };
    views.into_iter().filter(|view| is_drawn(view)).count()
}

pub(crate) fn hash_file(path: &Path) -> io::Result<Hash32> {
    Ok(Hash32::of_reader(fs_err::File::open(path)?)?.0)
}

/// Views without an image file, in the given order.
pub fn missing_images(views: &[View]) -> Vec<&View> {
    views.iter().filter(|view| !view.image_path.is_file()).collect()
}

/// Area of [`photo_size_px`].
pub(crate) fn photo_area_px(view: &View) -> u64 {
    photo_size_px(view).map(u64::from).iter().product()
}

/// Size of a view's photo by its header; the camera's if the header cannot be read.
fn photo_size_px(view: &View) -> [u32; 2] {
    let of_camera = (view.intrinsics.width_px, view.intrinsics.height_px);
    let (width_px, height_px) = photo::size_px(&view.image_path)
        .filter(|(width_px, height_px)| is_scale_of(&view.intrinsics, *width_px, *height_px))
        .unwrap_or(of_camera);
    [width_px, height_px]
}

pub fn check_memory(view: &View, free_bytes: u64) -> Result<(), IngestError> {
    let needed_bytes = photo_area_px(view).saturating_mul(LOADED_BYTES_PER_PX);
    if needed_bytes <= free_bytes {
        return Ok(());
    }
    let ([width_px, height_px], needed, free) =
        (photo_size_px(view), ByteSize(needed_bytes), ByteSize(free_bytes));
    let problem = format!(
        "{width_px} x {height_px} px take {needed} while they are loaded, and {free} are free; give smaller copies"
    );
    Err(IngestError::File { path: view.image_path.clone(), problem })
}

/// Loads the photo of a view and undistorts it.
///
/// If the image is a scaled copy of the original, the camera is scaled with it. Photos of pinhole cameras stay
/// unchanged. Transparent pixels are outside of the photo. An EXIF orientation is applied where only the turned
/// photo has its camera's size, and else ignored, see [`Oddity`].
pub fn load_image(view: &View) -> Result<LoadedImage, IngestError> {
    let (decoded, is_rotated) = decode(&view.image_path, &view.intrinsics)?;
    let rotated = is_rotated.then_some(Oddity::Rotated);
    let intrinsics = view.intrinsics.scaled_to(decoded.width(), decoded.height());
    let view = View { intrinsics: intrinsics.without_distortion(), ..view.clone() };
    let or_blank = |loaded: LoadedImage| match &loaded.valid {
        Some(valid) if !valid.contains(&true) => {
            let problem = "nothing of it is seen: it is transparent, or the camera's lens distortion leaves no pixel; give \
                           another copy, or leave the photo out";
            Err(IngestError::File { path: loaded.view.image_path.clone(), problem: problem.into() })
        }
        _ => Ok(loaded),
    };
    let (image, opaque) = photo::colours(decoded);
    if intrinsics.distortion == Distortion::None {
        return or_blank(LoadedImage { view, image, undistorter: None, valid: opaque, oddity: rotated });
    }
    let undistorter = Undistorter::new(intrinsics);
    let (image, mut valid) = undistorter.image(&image);
    let is_narrowed = 2 * valid.iter().filter(|valid| **valid).count() < valid.len();
    let oddity = if is_narrowed { Some(Oddity::Narrowed) } else { rotated };
    if let Some(opaque) = opaque {
        let labels: Vec<u32> = opaque.into_iter().map(u32::from).collect();
        let opaque = undistorter.labels(&labels, 0);
        valid.iter_mut().zip(opaque).for_each(|(valid, opaque)| *valid &= opaque == 1);
    }
    or_blank(LoadedImage { view, image, undistorter: Some(undistorter), valid: Some(valid), oddity })
}

/// Returns the pixels, and whether an EXIF orientation was ignored.
fn decode(path: &Path, camera: &Intrinsics) -> Result<(DynamicImage, bool), IngestError> {
    let failed = |fault| match fault {
        PhotoError::Io(error) => IngestError::Io(error),
        fault => IngestError::Photo { path: path.to_owned(), fault },
    };
    let mut decoder = photo::open(BufReader::new(files::open(path)?)).map_err(failed)?;
    let (width_px, height_px) = decoder.dimensions();
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    // Before any pixel is allocated.
    let fits = is_scale_of(camera, width_px, height_px);
    let turns = swaps_sides(orientation) && is_scale_of(camera, height_px, width_px);
    if !fits && !turns {
        return Err(IngestError::Size {
            path: path.to_owned(),
            found_px: [width_px, height_px],
            expected_px: [camera.width_px, camera.height_px],
        });
    }
    let mut photo = DynamicImage::from_decoder(decoder).map_err(|error| failed(error.into()))?;
    if !fits {
        photo.apply_orientation(orientation);
    }
    Ok((photo, fits && orientation != Orientation::NoTransforms))
}

fn swaps_sides(orientation: Orientation) -> bool {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    matches!(orientation, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH)
}

/// Whether a size is exactly proportional to the camera's, up to [`MAX_UPSCALE`] of it, or that divided by an integer
/// with each side rounded up or down, as in downscaled copies.
fn is_scale_of(camera: &Intrinsics, width_px: u32, height_px: u32) -> bool {
    let proportional = u64::from(width_px) * u64::from(camera.height_px)
        == u64::from(height_px) * u64::from(camera.width_px);
    let reduced = |side_px: u32, of_px: u32, n: u32| side_px == of_px / n || side_px == of_px.div_ceil(n);
    width_px > 0
        && height_px > 0
        && u64::from(width_px) <= MAX_UPSCALE * u64::from(camera.width_px)
        && (proportional
            || (2..=MAX_DOWNSCALE)
                .any(|n| reduced(width_px, camera.width_px, n) && reduced(height_px, camera.height_px, n)))
}

/// Mapping from a camera with distortion to the ideal pinhole of equal focal lengths, centre and size.
#[derive(Clone, Debug, PartialEq)]
pub struct Undistorter {
    /// At the size of the image.
    camera: Intrinsics,
    /// Normalised radius beyond which the lens polynomial is no longer monotonic.
    max_radius: f64,
}

impl Undistorter {
    /// `camera` must have the size of the images.
    pub fn new(camera: Intrinsics) -> Self {
        Self { camera, max_radius: camera.distortion.monotonic_radius() }
    }

    /// Position of an ideal pixel's centre in the distorted image, pixels; `None` outside the image or the lens model.
    fn source_px(&self, column: u32, row: u32) -> Option<[f64; 2]> {
        let ideal = self.camera.distorted_from_pixel([f64::from(column) + 0.5, f64::from(row) + 0.5]);
        if ideal[0].hypot(ideal[1]) > self.max_radius || self.camera.distortion.folds_at(ideal) {
            return None;
        }
        let [u, v] = self.camera.pixel_from_distorted(self.camera.distort(ideal));
        let inside = (0.0..f64::from(self.camera.width_px)).contains(&u)
            && (0.0..f64::from(self.camera.height_px)).contains(&v);
        inside.then_some([u, v])
    }

    /// Ideal image, bilinear, black outside the photo, and whether each pixel (row-major) is inside.
    pub fn image(&self, photo: &RgbImage) -> (RgbImage, Vec<bool>) {
        let (width_px, height_px) = (self.camera.width_px, self.camera.height_px);
        assert_eq!(photo.dimensions(), (width_px, height_px), "the undistorter is of another size");
        let mut valid = Vec::with_capacity(width_px as usize * height_px as usize);
        let mut ideal = RgbImage::new(width_px, height_px);
        for (column, row, pixel) in ideal.enumerate_pixels_mut() {
            let source = self.source_px(column, row);
            valid.push(source.is_some());
            if let Some(source) = source {
                pixel.0 = bilinear(photo, source);
            }
        }
        (ideal, valid)
    }

    /// Maps labels (row-major) to the ideal image, nearest neighbour; pixels outside the photo get `outside`.
    pub fn labels(&self, labels: &[u32], outside: u32) -> Vec<u32> {
        let (width_px, height_px) = (self.camera.width_px, self.camera.height_px);
        assert_eq!(
            labels.len(),
            width_px as usize * height_px as usize,
            "the undistorter is of another size"
        );
        let mut ideal = Vec::with_capacity(labels.len());
        for row in 0..height_px {
            ideal.extend((0..width_px).map(|column| match self.source_px(column, row) {
                // Truncation is correct: pixel i spans i..i + 1.
                Some([u, v]) => labels[v as usize * width_px as usize + u as usize],
                None => outside,
            }));
        }
        ideal
    }
}

/// Bilinear colour at a position in pixels; within half a pixel of the border, that of the edge.
fn bilinear(image: &RgbImage, [u, v]: [f64; 2]) -> [u8; 3] {
    let axis = |position: f64, size_px: u32| {
        let from_centre = (position - 0.5).clamp(0.0, f64::from(size_px - 1));
        let low = from_centre as u32;
        (low, (low + 1).min(size_px - 1), from_centre - f64::from(low))
    };
    let (x0, x1, fx) = axis(u, image.width());
    let (y0, y1, fy) = axis(v, image.height());
    let [a, b, c, d] = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| image.get_pixel(x, y).0);
    [0, 1, 2].map(|channel| {
        let [a, b, c, d] = [a, b, c, d].map(|colour| f64::from(colour[channel]));
        let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
        (top + (bottom - top) * fy).round() as u8
    })
}

/// Warns of harmonics that are not finite, and takes them as 0.
pub(crate) fn drop_broken_harmonics(scene: &mut Gaussians) {
    match scene.drop_broken_harmonics() {
        0 => {}
        n => tracing::warn!(
            "{n} of {} Gaussians have harmonics (f_rest) that are not finite; they are drawn without",
            scene.len()
        ),
    }
}
