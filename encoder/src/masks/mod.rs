//! Masks of an image, and the partition of the image into regions.

mod mask;
pub mod patches;
pub mod regions;
pub mod rle;

use image::{Rgb, RgbImage, imageops};

pub use mask::{Bits, BoxPx, Mask, NO_REGION, masks_of_labels};
pub use regions::RegionMap;

/// Share of the mask's colour inside it.
const TINT: f32 = 0.35;
/// Hue step between masks: the golden ratio keeps neighbours in the list apart.
const HUE_STEP: f32 = 0.618_034;

/// Draws masks over a photo, at most `width_px` wide, tinted with a border, each in its own colour; later ones on top.
pub fn overlay(photo: &RgbImage, masks: &[Mask], width_px: u32) -> RgbImage {
    let width = width_px.min(photo.width()).max(1);
    let scale = f64::from(photo.width()) / f64::from(width);
    let height = ((f64::from(photo.height()) / scale).round() as u32).max(1);
    let mut picture = imageops::thumbnail(photo, width, height);
    // Pixel of the photo under the middle of a pixel of the picture.
    let in_photo = |at: u32, n: u32| ((f64::from(at) + 0.5) * scale).min(f64::from(n) - 1.0) as u32;
    for (number, mask) in masks.iter().enumerate() {
        let colour = hue((number as f32 * HUE_STEP).fract());
        let is_inside = |x: i64, y: i64| {
            let is_there = (0..i64::from(width)).contains(&x) && (0..i64::from(height)).contains(&y);
            is_there && mask.contains(in_photo(x as u32, photo.width()), in_photo(y as u32, photo.height()))
        };
        let BoxPx { x0, y0, x1, y1 } = mask.box_px;
        let scaled = |from: u32, to: u32, n: u32| {
            (f64::from(from) / scale) as u32..((f64::from(to) / scale).ceil() as u32).min(n)
        };
        for y in scaled(y0, y1, height) {
            for x in scaled(x0, x1, width) {
                let (u, v) = (i64::from(x), i64::from(y));
                if !is_inside(u, v) {
                    continue;
                }
                let beside = [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)];
                let share = if beside.iter().all(|(x, y)| is_inside(*x, *y)) { TINT } else { 1.0 };
                let Rgb(pixel) = picture.get_pixel_mut(x, y);
                for (value, of_mask) in pixel.iter_mut().zip(colour) {
                    *value = (f32::from(*value) + (of_mask - f32::from(*value)) * share).round() as u8;
                }
            }
        }
    }
    picture
}

fn hue(hue: f32) -> [f32; 3] {
    [0.0, 2.0, 4.0].map(|shift: f32| {
        let distance = ((hue * 6.0 - shift).rem_euclid(6.0) - 3.0).abs();
        255.0 * (distance - 1.0).clamp(0.0, 1.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_where_they_are_in_the_photo() {
        let photo = RgbImage::from_pixel(80, 40, Rgb([100; 3]));
        let box_px = BoxPx { x0: 20, y0: 8, x1: 60, y1: 32 };
        let picture = overlay(&photo, &[Mask::within(box_px, |x, y| x < 40 || y < 20)], 40);
        assert_eq!(picture.dimensions(), (40, 20));
        // The first colour is red. By hand, in half-size pixels: inside, on the border, in the notch, outside.
        assert_eq!(picture.get_pixel(15, 8).0, [154, 65, 65]);
        assert_eq!(picture.get_pixel(10, 8).0, [255, 0, 0]);
        for (x, y) in [(25, 13), (9, 8), (30, 8), (15, 3), (15, 16)] {
            assert_eq!(picture.get_pixel(x, y).0, [100; 3], "{x}, {y}");
        }
        assert_eq!(overlay(&photo, &[], 500).dimensions(), (80, 40));
    }
}
