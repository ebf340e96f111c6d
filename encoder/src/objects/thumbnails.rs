//! Small pictures of objects, each cut from the photo that shows the object best.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{GenericImageView, RgbImage, SubImage};
use rayon::prelude::*;
use slag_common::View;
use slag_common::objects::MAX_THUMBNAIL_BYTES;

use super::object::Object;
use crate::progress::Progress;

/// Longest edge.
const EDGE_PX: u32 = 128;
/// Margin on each side, as a share of the box's longer edge.
const AROUND: f64 = 0.15;
/// The best one with a short enough file is taken. Noise has 9 kB with the least.
const JPEG_QUALITIES: [u8; 2] = [75, 30];

type Cuts = Vec<(usize, Vec<u8>)>;

/// Cuts a JPEG thumbnail per object, `[n]`: empty if its photo is unreadable or the run was cancelled. Also returns the
/// first error. `views`: sorted by name.
pub(crate) fn cut<E: Send>(
    objects: &[Object],
    views: &[&View],
    load: impl Fn(&View) -> Result<RgbImage, E> + Sync,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> (Vec<Vec<u8>>, Option<E>) {
    let mut of_photo: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    (0..objects.len()).for_each(|object| of_photo.entry(&objects[object].photo).or_default().push(object));
    progress.begin("thumbnails", "photo", of_photo.len() as u64, 0);
    let cut_all = |(name, objects_here): (&str, Vec<usize>)| {
        let found = views.binary_search_by(|view| view.name.as_str().cmp(name)).ok();
        let Some(view) = found.filter(|_| !cancel.load(Ordering::Relaxed)) else { return Ok(Vec::new()) };
        let photo = load(views[view]);
        progress.advance(1);
        let cut = |photo: RgbImage| {
            objects_here.iter().map(|object| (*object, jpeg(&photo, objects[*object].photo_box_px))).collect()
        };
        photo.map(cut)
    };
    let cuts: Vec<Result<Cuts, E>> = of_photo.into_par_iter().map(cut_all).collect();
    progress.end();
    let (mut thumbnails, mut fault) = (vec![Vec::new(); objects.len()], None);
    for cuts in cuts {
        match cuts {
            Ok(cuts) => cuts.into_iter().for_each(|(object, jpeg)| thumbnails[object] = jpeg),
            Err(error) => fault = fault.or(Some(error)),
        }
    }
    (thumbnails, fault)
}

/// JPEG of a photo around a box, at most [`EDGE_PX`] wide and high.
fn jpeg(photo: &RgbImage, box_px: [u32; 4]) -> Vec<u8> {
    let cut = around(photo, box_px);
    let (width, height) = (cut.width(), cut.height());
    let scale = f64::from(EDGE_PX) / f64::from(width.max(height).max(EDGE_PX));
    let scaled = |edge: u32| ((f64::from(edge) * scale).round() as u32).max(1);
    let picture = imageops::resize(&*cut, scaled(width), scaled(height), FilterType::Triangle);
    let encoded = JPEG_QUALITIES.into_iter().map(|quality| {
        let mut bytes = Vec::new();
        let encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
        picture.write_with_encoder(encoder).expect("writing to memory cannot fail");
        bytes
    });
    encoded.into_iter().find(|bytes| bytes.len() <= MAX_THUMBNAIL_BYTES).unwrap_or_default()
}

fn around(photo: &RgbImage, [x0, y0, x1, y1]: [u32; 4]) -> SubImage<&RgbImage> {
    let margin = (f64::from((x1 - x0).max(y1 - y0)) * AROUND).round() as u32;
    let range = |low: u32, high: u32, size: u32| {
        let start = low.saturating_sub(margin).min(size - 1);
        (start, (high + margin).clamp(start + 1, size) - start)
    };
    let ((x, width), (y, height)) = (range(x0, x1, photo.width()), range(y0, y1, photo.height()));
    imageops::crop_imm(photo, x, y, width, height)
}

#[cfg(test)]
mod tests {
    use image::{ImageFormat, Rgb};

    use super::*;

    /// By hand: a box of 300 x 100 px at (90, 30). The margin is 45 px, but only 30 above the box.
    #[test]
    fn the_box_is_shown_with_a_margin_and_made_small() {
        let is_inside = |x: u32, y: u32| (90..390).contains(&x) && (30..130).contains(&y);
        let photo =
            RgbImage::from_fn(600, 400, |x, y| Rgb(if is_inside(x, y) { [250, 10, 10] } else { [0; 3] }));
        let cut = around(&photo, [90, 30, 390, 130]);
        assert_eq!((cut.offsets(), cut.width(), cut.height()), ((45, 0), 390, 175));
        let bytes = jpeg(&photo, [90, 30, 390, 130]);
        let picture =
            image::load_from_memory_with_format(&bytes, ImageFormat::Jpeg).expect("a JPEG").to_rgb8();
        assert_eq!(picture.dimensions(), (128, 57));
        assert!(picture.get_pixel(64, 26)[0] > 220 && picture.get_pixel(4, 53)[0] < 30);
        // Small ones are not enlarged, and those at a corner are cut.
        assert_eq!(around(&photo, [590, 390, 600, 400]).width(), 12);
        let small = image::load_from_memory(&jpeg(&photo, [590, 390, 600, 400])).expect("a JPEG");
        assert_eq!((small.width(), small.height()), (12, 12));
    }

    /// The worst that a photo can hold.
    #[test]
    fn noise_fits() {
        let mut random = slag_math::random::Random::new(3);
        let photo = RgbImage::from_fn(128, 128, |_, _| Rgb([0; 3].map(|_: u8| random.bits() as u8)));
        let len = jpeg(&photo, [0, 0, 128, 128]).len();
        assert!((1..=MAX_THUMBNAIL_BYTES).contains(&len), "{len}");
    }
}
