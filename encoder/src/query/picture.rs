//! A view of the scene in which the Gaussians that answer keep their colours and all others are grey.

use image::RgbImage;
use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;

use crate::raster::{CpuRasterizer, RasterError, RasterView, Rasterizer};

const BACKGROUND: [f32; 3] = [0.9; 3];

/// Draws a scene with the Gaussians of `cosines` (`[N]`) at or above the threshold lit, at the view's own size.
pub fn draw_lit(
    scene: &Gaussians,
    cosines: &[f32],
    threshold: f32,
    view: &RasterView,
) -> Result<RgbImage, RasterError> {
    let mut coloured = scene.clone();
    for (index, cosine) in cosines.iter().enumerate() {
        // NaN compares false: a Gaussian without an embedding stays grey.
        if *cosine >= threshold {
            continue;
        }
        // Lightened so that dark furniture still shows its shape.
        let grey = 0.35 + 0.5 * luma(scene.rgb_dc(index));
        coloured.sh_dc[index] = [(grey - 0.5) / SH_C0; 3];
        let rest = coloured.sh_rest.len() / cosines.len();
        coloured.sh_rest[index * rest..][..rest].fill(0.0);
    }
    let drawing = CpuRasterizer.draw(&coloured, view, BACKGROUND)?;
    let bytes = drawing.rgb.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    Ok(RgbImage::from_raw(drawing.width_px, drawing.height_px, bytes)
        .expect("a drawing has three values per pixel"))
}

/// Returns the brightness of a colour (BT.601).
pub fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}
