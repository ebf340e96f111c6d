//! A photo with its camera, and its comparison with a drawing.

use std::io::Cursor;

use image::imageops::{self, FilterType};
use image::{GrayImage, ImageFormat, Luma, Rgb, RgbImage};

use crate::ingest::{IngestError, LoadedImage};
use crate::raster::{Drawing, LoadedScene, RasterError, RasterView};

#[derive(Clone, Debug)]
pub struct CheckView {
    pub name: String,
    pub image: RgbImage,
    /// Pixels of the photo are 255, others 0, row-major; `None` if all belong to it.
    pub valid: Option<GrayImage>,
    /// At the photo's resolution.
    pub view: RasterView,
}

impl From<LoadedImage> for CheckView {
    fn from(loaded: LoadedImage) -> Self {
        let LoadedImage { view, image, valid, .. } = loaded;
        let bytes = valid.map(|valid| valid.into_iter().map(|valid| 255 * u8::from(valid)).collect());
        let valid = bytes.and_then(|bytes| GrayImage::from_raw(image.width(), image.height(), bytes));
        Self { view: RasterView::of(&view), name: view.name, image, valid }
    }
}

/// Scales a view down to a width, the photo with a filter that averages over the pixels it drops.
pub(super) fn at_width(view: &CheckView, width_px: u32) -> Result<CheckView, CheckError> {
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
    let valid = view
        .valid
        .as_ref()
        .map(|valid| imageops::resize(valid, intrinsics.width_px, intrinsics.height_px, FilterType::Nearest));
    Ok(CheckView { name: view.name.clone(), image, valid, view: RasterView { intrinsics, ..view.view } })
}

/// PSNR of a picture against a photo, dB; 100 where they are equal.
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

/// Largest variance of colours behind a splat, from 0 to 1: that of a sky without clouds. What shows through holes varies
/// more.
const MAX_BEHIND_VARIANCE: f64 = 0.01;

/// Opacity above which a drawing shows the splat.
pub(super) const MIN_COVERAGE: f32 = 0.5;

/// PSNR against the mean colour from which a photo is plain, as under a lens cap, and tells nothing of the others.
pub(super) const PLAIN_DB: f64 = 40.0;

impl CheckView {
    /// Draws the view over black, like trainers of splats.
    pub(super) fn draw(&self, scene: &dyn LoadedScene) -> Result<Drawing, CheckError> {
        scene
            .draw(&self.view, [0.0; 3])
            .map_err(|source| CheckError::Raster { view: self.name.clone(), source })
    }

    /// PSNR of a drawing against the photo, dB. Where the splat shows nothing, it is black, or has the photo's mean colour
    /// there if the photo is nearly plain there: a splat need not show the sky, or the backdrop of a thing.
    pub(super) fn likeness_db(&self, drawing: &Drawing) -> f64 {
        let is_bare = |pixel: usize| drawing.coverage[pixel] <= MIN_COVERAGE;
        let drawn = |pixel: usize, c: usize| drawing.rgb[pixel * 3 + c];
        let on_black_db = self.psnr_db(drawn);
        // Of a drawing of nothing, that would be the plain colour that drawings are to surpass.
        if (0..drawing.coverage.len()).all(is_bare) {
            return on_black_db;
        }
        let behind = self.mean_colour(is_bare);
        let square = |photo: u8, c: usize| (f64::from(photo) / 255.0 - f64::from(behind[c])).powi(2);
        if mean(self.pixels(is_bare).flat_map(|photo| (0..3).map(move |c| square(photo[c], c))))
            > MAX_BEHIND_VARIANCE
        {
            return on_black_db;
        }
        let filled = |pixel: usize, c: usize| match is_bare(pixel) {
            true => behind[c],
            false => drawn(pixel, c) + (1.0 - drawing.coverage[pixel]) * behind[c],
        };
        on_black_db.max(self.psnr_db(filled))
    }

    /// Leaves out the pixels that the drawing does not cover.
    pub(super) fn leave_out(&mut self, drawing: &Drawing) {
        let (width_px, height_px) = self.image.dimensions();
        let valid = self.valid.get_or_insert_with(|| GrayImage::from_pixel(width_px, height_px, Luma([255])));
        let bare =
            valid.pixels_mut().zip(&drawing.coverage).filter(|(_, coverage)| **coverage <= MIN_COVERAGE);
        bare.for_each(|(pixel, _)| *pixel = Luma([0]));
    }

    pub(super) fn is_plain(&self) -> bool {
        self.flat_psnr_db() >= PLAIN_DB
    }

    /// Pixels that belong to the photo, those of them that are asked for.
    fn pixels(&self, is_asked_for: impl Fn(usize) -> bool) -> impl Iterator<Item = &Rgb<u8>> {
        let all = self.image.pixels().enumerate();
        all.filter(move |(at, _)| self.is_valid(*at) && is_asked_for(*at)).map(|(_, colour)| colour)
    }

    /// From 0 to 1.
    fn mean_colour(&self, is_asked_for: impl Fn(usize) -> bool) -> [f32; 3] {
        let of = |c: usize| self.pixels(&is_asked_for).map(move |colour| f64::from(colour[c]) / 255.0);
        std::array::from_fn(|c| mean(of(c)) as f32)
    }

    fn is_valid(&self, pixel: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid.as_raw()[pixel] > 0)
    }

    /// Over the pixels that belong to the photo, dB.
    pub(super) fn psnr_db(&self, value: impl Fn(usize, usize) -> f32) -> f64 {
        let Some(valid) = &self.valid else { return psnr_db(&self.image, value) };
        let of_photo = |pixel: usize, c: usize| f32::from(self.image.as_raw()[pixel * 3 + c]) / 255.0;
        let share = mean(valid.pixels().map(|valid| f64::from(u8::from(valid[0] > 0)))).max(1e-6);
        let all = psnr_db(&self.image, |pixel, c| match valid.as_raw()[pixel] {
            0 => of_photo(pixel, c),
            _ => value(pixel, c),
        });
        all + 10.0 * share.log10()
    }

    pub(super) fn flat_psnr_db(&self) -> f64 {
        let colour = self.mean_colour(|_| true);
        self.psnr_db(|_, c| colour[c])
    }
}

/// A PNG with the photo on the left and the drawing on the right.
pub(super) fn picture(view: &CheckView, drawing: &Drawing) -> Result<Vec<u8>, CheckError> {
    let (width_px, height_px) = view.image.dimensions();
    let mut picture = RgbImage::new(width_px * 2, height_px);
    imageops::replace(&mut picture, &view.image, 0, 0);
    imageops::replace(&mut picture, &drawing.image(), i64::from(width_px), 0);
    let mut png = Cursor::new(Vec::new());
    picture
        .write_to(&mut png, ImageFormat::Png)
        .map_err(|source| CheckError::Encode { view: view.name.clone(), source })?;
    Ok(png.into_inner())
}

/// Unique by its index, safe for any view name.
pub(super) fn picture_name(index: usize, view_name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    format!("{index:04}_{}.png", view_name.chars().map(safe).take(120).collect::<String>())
}

/// Mean; 0 without values.
pub(super) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0_usize), |(sum, n), v| (sum + v, n + 1));
    sum / n.max(1) as f64
}

#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    #[error("no views to check; give at least one photo with its pose")]
    NoViews,
    #[error("none of the {n_views} sampled photos can be read, the first: {first}")]
    NoPhotos { n_views: usize, first: IngestError },
    #[error(
        "view {view}: the photo has {} x {} px but its camera {} x {} px; give the photo that the camera describes",
        image_px[0], image_px[1], camera_px[0], camera_px[1]
    )]
    ImageSize { view: String, image_px: [u32; 2], camera_px: [u32; 2] },
    #[error("view {view}: {source}")]
    Raster { view: String, source: RasterError },
    #[error(transparent)]
    Scene(#[from] RasterError),
    #[error("view {view}: cannot encode its picture ({source}); choose a smaller width")]
    Encode { view: String, source: image::ImageError },
    #[error("{0}; choose another folder for the pictures")]
    Write(#[from] std::io::Error),
}
