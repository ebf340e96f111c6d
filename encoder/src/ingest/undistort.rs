//! Undistortion: each pixel of the ideal pinhole image looks up its position in the photo.

use image::RgbImage;
use slag_common::Intrinsics;

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
