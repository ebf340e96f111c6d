//! Checks before any expensive work that photos, poses and scene belong together: draws sample views,
//! compares them with the photos, and looks for the usual mistakes where they do not agree.

use std::fmt;
use std::io::Cursor;
use std::path::PathBuf;

use glam::{DAffine3, DMat3, DVec3};
use image::imageops::{self, FilterType};
use image::{ImageFormat, RgbImage};
use serde::Serialize;
use slag_common::Gaussians;

use crate::raster::{Drawing, RasterError, RasterView, Rasterizer};

/// A photo and the camera it is said to be taken with.
#[derive(Clone, Debug)]
pub struct CheckView {
    /// Name of the view.
    pub name: String,
    /// The undistorted photo.
    pub image: RgbImage,
    /// Its camera, at the resolution of the photo.
    pub view: RasterView,
}

/// How to check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckOptions {
    /// Width at which views are compared, pixels; photos are never enlarged.
    pub width_px: u32,
    /// Where to write a picture of each view (photo left, drawing right); nowhere if `None`.
    pub pictures_dir: Option<PathBuf>,
    /// Width at which mistakes are looked for, pixels.
    pub diagnosis_width_px: u32,
    /// Views, spread over the given ones, in which mistakes are looked for.
    pub diagnosis_views: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { width_px: 800, pictures_dir: None, diagnosis_width_px: 240, diagnosis_views: 4 }
    }
}

/// What the check of one view gave.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewCheck {
    /// Name of the view.
    pub name: String,
    /// Peak signal-to-noise ratio of the drawing against the photo, dB.
    pub psnr_db: f64,
    /// The same of a plane of the photo's mean colour: what knowing nothing gives.
    pub flat_psnr_db: f64,
    /// Share of the image that the scene covers (alpha above 0.5).
    pub covered_share: f64,
    /// Gaussians in view.
    pub visible_gaussians: usize,
}

/// What the check of a scene gave.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckReport {
    /// The views, in the order given.
    pub views: Vec<ViewCheck>,
    /// Mean over the views, dB.
    pub mean_psnr_db: f64,
    /// Mean over the views, dB.
    pub mean_flat_psnr_db: f64,
    /// Mean over the views.
    pub mean_covered_share: f64,
    /// Gaussians that cannot be drawn in a view; the most of all views.
    pub unusable_gaussians: usize,
    /// What may be wrong; `None` where the drawings explain the photos.
    pub diagnosis: Option<Diagnosis>,
}

/// A table of the views, and what may be wrong.
impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<28} {:>8} {:>14} {:>9} {:>10}",
            "view", "PSNR dB", "plain colour", "covered", "Gaussians"
        )?;
        for view in &self.views {
            let covered = format!("{:.0} %", view.covered_share * 100.0);
            let (psnr_db, flat_db, n) = (view.psnr_db, view.flat_psnr_db, view.visible_gaussians);
            writeln!(f, "{:<28} {psnr_db:>8.2} {flat_db:>14.2} {covered:>9} {n:>10}", view.name)?;
        }
        let covered = format!("{:.0} %", self.mean_covered_share * 100.0);
        writeln!(
            f,
            "{:<28} {:>8.2} {:>14.2} {covered:>9}",
            "mean", self.mean_psnr_db, self.mean_flat_psnr_db
        )?;
        match &self.diagnosis {
            None => writeln!(f, "the drawings explain the photos"),
            Some(Diagnosis { mistake: Some(mistake), tried, .. }) => {
                let best_db = tried.first().map_or(f64::NAN, |trial| trial.psnr_db);
                writeln!(
                    f,
                    "the drawings do not explain the photos; likely: {mistake} (then {best_db:.2} dB)"
                )
            }
            Some(_) => writeln!(
                f,
                "the drawings do not explain the photos, and no usual mistake does: is it the scene of these photos, \
                 in the frame of these poses?"
            ),
        }
    }
}

/// The search for a mistake.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Diagnosis {
    /// PSNR of the searched views as they were given, dB.
    pub given_psnr_db: f64,
    /// The mistake whose correction explains the photos, if any does.
    pub mistake: Option<Mistake>,
    /// Every correction tried with the PSNR it gave, best first.
    pub tried: Vec<Trial>,
    /// Size of the box around the middle 90 % of the Gaussians along each axis: its diagonal, world units.
    pub scene_diagonal: f64,
    /// Largest distance of a camera from the cameras' mean position, world units.
    pub camera_spread: f64,
    /// The same in sentences for a person.
    pub advice: Vec<String>,
}

/// A correction and what it gave.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Trial {
    /// The mistake that was corrected.
    pub mistake: Mistake,
    /// Mean PSNR after the correction, dB.
    pub psnr_db: f64,
}

/// A usual mistake in poses or intrinsics.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Mistake {
    /// Camera axes are OpenGL's (x right, y up, z back).
    OpenGlAxes,
    /// The transforms are world-from-camera.
    WorldFromCamera,
    /// Both, as in a NeRF `transforms.json`.
    WorldFromOpenGlCamera,
    /// The scene is this many times as large as the world of the cameras.
    SceneScale(f64),
    /// Focal lengths must be multiplied by this.
    FocalScale(f64),
    /// The scene must be turned about the world's x axis by this many quarters (y up taken for z up,
    /// or the reverse).
    WorldQuarterTurns(u8),
}

/// Every mistake that is tried.
const MISTAKES: [Mistake; 12] = [
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

/// How much better a correction must be, and a drawing than a plain colour, to mean anything, dB.
const CLEAR_GAIN_DB: f64 = 3.0;

impl Mistake {
    /// Returns the view without the mistake.
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
                "the scene is {factor} times as large as the cameras' world; multiply the cameras' positions by {factor}"
            ),
            Self::FocalScale(factor) => {
                write!(f, "the focal length is of another image size or sensor; multiply it by {factor}")
            }
            Self::WorldQuarterTurns(quarters) => write!(
                f,
                "scene and cameras disagree about which axis is up; turn the scene by {} degrees about x",
                u32::from(*quarters) * 90
            ),
        }
    }
}

/// Why a check cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// Nothing to check.
    #[error("no views to check; give at least one photo with its pose")]
    NoViews,
    /// Photo and camera differ in size.
    #[error(
        "view {view}: the photo has {image_px:?} pixels, its camera {camera_px:?}; undistort the photo or scale the camera"
    )]
    ImageSize {
        /// Name of the view.
        view: String,
        /// Width and height of the photo.
        image_px: [u32; 2],
        /// Width and height of the camera.
        camera_px: [u32; 2],
    },
    /// A view cannot be drawn.
    #[error("view {view}: {source}")]
    Raster {
        /// Name of the view.
        view: String,
        /// Why.
        source: RasterError,
    },
    /// A picture cannot be encoded.
    #[error("view {view}: the picture cannot be encoded ({source}); check a smaller width")]
    Encode {
        /// Name of the view.
        view: String,
        /// Why.
        source: image::ImageError,
    },
    /// A picture cannot be written.
    #[error("{0}; choose another folder for the pictures")]
    Write(#[from] std::io::Error),
}

/// Draws the views of a scene and compares them with the photos.
///
/// # Errors
/// [`CheckError`] for views that cannot be drawn and pictures that cannot be written; a scene that does
/// not fit the photos is no error but a [`Diagnosis`].
pub fn check(
    scene: &Gaussians,
    views: &[CheckView],
    rasterizer: &dyn Rasterizer,
    options: &CheckOptions,
) -> Result<CheckReport, CheckError> {
    if views.is_empty() {
        return Err(CheckError::NoViews);
    }
    if let Some(dir) = &options.pictures_dir {
        fs_err::create_dir_all(dir)?;
    }
    let mut checks = Vec::with_capacity(views.len());
    let mut unusable_gaussians = 0;
    for (index, view) in views.iter().enumerate() {
        let small = at_width(view, options.width_px)?;
        let drawing = draw(scene, &small, rasterizer)?;
        unusable_gaussians = unusable_gaussians.max(drawing.counters.unusable);
        if let Some(dir) = &options.pictures_dir {
            fs_err::write(dir.join(picture_name(index, &view.name)), picture(&small, &drawing)?)?;
        }
        checks.push(ViewCheck {
            name: view.name.clone(),
            psnr_db: psnr_db(&small.image, |pixel, c| drawing.rgb[pixel * 3 + c]),
            flat_psnr_db: flat_psnr_db(&small.image),
            covered_share: mean(drawing.coverage.iter().map(|&alpha| f64::from(u8::from(alpha > 0.5)))),
            visible_gaussians: drawing.counters.visible,
        });
    }
    let mut report = CheckReport {
        mean_psnr_db: mean(checks.iter().map(|c| c.psnr_db)),
        mean_flat_psnr_db: mean(checks.iter().map(|c| c.flat_psnr_db)),
        mean_covered_share: mean(checks.iter().map(|c| c.covered_share)),
        views: checks,
        unusable_gaussians,
        diagnosis: None,
    };
    if report.mean_psnr_db < report.mean_flat_psnr_db + CLEAR_GAIN_DB {
        report.diagnosis = Some(diagnose(scene, views, rasterizer, options, &report)?);
    }
    Ok(report)
}

/// Tries every correction on a few small views.
fn diagnose(
    scene: &Gaussians,
    views: &[CheckView],
    rasterizer: &dyn Rasterizer,
    options: &CheckOptions,
    report: &CheckReport,
) -> Result<Diagnosis, CheckError> {
    let n = options.diagnosis_views.clamp(1, views.len());
    let samples = (0..n)
        .map(|i| at_width(&views[i * views.len() / n], options.diagnosis_width_px))
        .collect::<Result<Vec<_>, _>>()?;
    let psnr_with = |correct: &dyn Fn(&RasterView) -> RasterView| -> Result<f64, CheckError> {
        let mut sum = 0.0;
        for sample in &samples {
            let drawing =
                draw(scene, &CheckView { view: correct(&sample.view), ..sample.clone() }, rasterizer)?;
            sum += psnr_db(&sample.image, |pixel, c| drawing.rgb[pixel * 3 + c]);
        }
        Ok(sum / n as f64)
    };
    let given_psnr_db = psnr_with(&|view| *view)?;
    let mut tried = MISTAKES
        .into_iter()
        .map(|mistake| Ok(Trial { mistake, psnr_db: psnr_with(&|view| mistake.corrected(view))? }))
        .collect::<Result<Vec<_>, CheckError>>()?;
    tried.sort_by(|a, b| b.psnr_db.total_cmp(&a.psnr_db));
    // A correction that only turns black into some colour gains too, but never on the mean colour.
    let flat_db = mean(samples.iter().map(|sample| flat_psnr_db(&sample.image)));
    let mistake = tried
        .first()
        .filter(|best| best.psnr_db > given_psnr_db + CLEAR_GAIN_DB && best.psnr_db > flat_db)
        .map(|best| best.mistake);
    let mut diagnosis = Diagnosis {
        given_psnr_db,
        mistake,
        tried,
        scene_diagonal: scene_diagonal(scene),
        camera_spread: camera_spread(views),
        advice: Vec::new(),
    };
    diagnosis.advice = advice(&diagnosis, report);
    Ok(diagnosis)
}

fn advice(diagnosis: &Diagnosis, report: &CheckReport) -> Vec<String> {
    let mut advice = Vec::new();
    match diagnosis.mistake {
        Some(mistake) => advice.push(format!(
            "{mistake} (PSNR {:.1} dB instead of {:.1} dB)",
            diagnosis.tried[0].psnr_db, diagnosis.given_psnr_db
        )),
        None => advice.push(format!(
            "the drawings explain the photos hardly better than one colour (PSNR {:.1} dB, one colour {:.1} dB), \
             and no usual mistake is behind it; check that photos, poses and scene are of the same reconstruction",
            report.mean_psnr_db, report.mean_flat_psnr_db
        )),
    }
    if diagnosis.mistake.is_none() && report.mean_covered_share < 0.5 {
        advice.push(format!(
            "the scene covers {:.0} % of the images; the cameras look away from it or stand far off",
            report.mean_covered_share * 100.0
        ));
    }
    let Diagnosis { scene_diagonal, camera_spread, .. } = *diagnosis;
    if camera_spread > 0.0 && !(0.05..=200.0).contains(&(scene_diagonal / camera_spread)) {
        advice.push(format!(
            "the scene measures {scene_diagonal:.3} and the cameras spread over {camera_spread:.3}; \
             are both in the same unit?"
        ));
    }
    advice
}

/// Scales a view down to a width; the photo by a filter that averages all pixels it leaves out.
fn at_width(view: &CheckView, width_px: u32) -> Result<CheckView, CheckError> {
    let camera = view.view.intrinsics;
    let (image_px, camera_px) = (view.image.dimensions(), (camera.width_px, camera.height_px));
    if image_px != camera_px || image_px.0 == 0 || image_px.1 == 0 {
        return Err(CheckError::ImageSize {
            view: view.name.clone(),
            image_px: image_px.into(),
            camera_px: camera_px.into(),
        });
    }
    let intrinsics = camera.scaled_to_width(width_px.clamp(1, image_px.0));
    let image =
        imageops::resize(&view.image, intrinsics.width_px, intrinsics.height_px, FilterType::Lanczos3);
    Ok(CheckView { name: view.name.clone(), image, view: RasterView { intrinsics, ..view.view } })
}

/// Draws a view over black, as trainers do.
fn draw(scene: &Gaussians, view: &CheckView, rasterizer: &dyn Rasterizer) -> Result<Drawing, CheckError> {
    rasterizer
        .draw(scene, &view.view, [0.0; 3])
        .map_err(|source| CheckError::Raster { view: view.name.clone(), source })
}

/// Returns the PSNR of a picture against a photo, dB; 100 where they are equal.
pub fn psnr_db(photo: &RgbImage, value: impl Fn(usize, usize) -> f32) -> f64 {
    let squares = photo.pixels().enumerate().flat_map(|(pixel, photo)| {
        let value = &value;
        (0..3).map(move |c| {
            let difference = value(pixel, c).clamp(0.0, 1.0) - f32::from(photo[c]) / 255.0;
            f64::from(difference * difference)
        })
    });
    -10.0 * mean(squares).max(1e-10).log10()
}

/// Returns the PSNR of the photo's mean colour, dB.
fn flat_psnr_db(photo: &RgbImage) -> f64 {
    let colour: [f32; 3] =
        std::array::from_fn(|c| mean(photo.pixels().map(|p| f64::from(p[c]) / 255.0)) as f32);
    psnr_db(photo, |_, c| colour[c])
}

/// Returns a PNG of the photo beside the drawing.
fn picture(view: &CheckView, drawing: &Drawing) -> Result<Vec<u8>, CheckError> {
    let (width_px, height_px) = view.image.dimensions();
    let picture = RgbImage::from_fn(width_px * 2, height_px, |x, y| {
        if x < width_px {
            return *view.image.get_pixel(x, y);
        }
        let start = ((y * width_px + x - width_px) * 3) as usize;
        image::Rgb(std::array::from_fn(|c| (drawing.rgb[start + c].clamp(0.0, 1.0) * 255.0).round() as u8))
    });
    let mut png = Cursor::new(Vec::new());
    picture
        .write_to(&mut png, ImageFormat::Png)
        .map_err(|source| CheckError::Encode { view: view.name.clone(), source })?;
    Ok(png.into_inner())
}

/// Returns a file name that is unique for the index and safe for any view name.
fn picture_name(index: usize, view_name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    format!("{index:04}_{}.png", view_name.chars().map(safe).take(120).collect::<String>())
}

/// Returns the diagonal of the box that holds the middle 90 % of the means along each axis.
fn scene_diagonal(scene: &Gaussians) -> f64 {
    let size = |axis: usize| {
        let finite = |p: &DVec3| Some(p[axis]).filter(|v| v.is_finite());
        let mut values: Vec<f64> = scene.means_in_world.iter().filter_map(finite).collect();
        values.sort_unstable_by(f64::total_cmp);
        let at = |percent: usize| values.get(values.len().saturating_sub(1) * percent / 100).copied();
        at(95).unwrap_or(0.0) - at(5).unwrap_or(0.0)
    };
    DVec3::new(size(0), size(1), size(2)).length()
}

/// Returns the largest distance of a camera from the cameras' mean position.
fn camera_spread(views: &[CheckView]) -> f64 {
    let positions: Vec<DVec3> =
        views.iter().map(|v| v.view.camera_from_world.inverse().translation).collect();
    let centre = positions.iter().sum::<DVec3>() / positions.len() as f64;
    positions.iter().map(|p| p.distance(centre)).fold(0.0, f64::max)
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0_usize), |(sum, n), v| (sum + v, n + 1));
    sum / n.max(1) as f64
}
