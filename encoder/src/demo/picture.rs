//! What the robot found, drawn: each answer's Gaussians in colour, the rest of the room in grey.

use image::{RgbImage, imageops};
use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;

use super::EdgeAnswer;
use crate::generate::to_image;
use crate::raster::{CpuRasterizer, RasterError, RasterView, Rasterizer};

/// Width of one panel.
const PANEL_WIDTH_PX: u32 = 320;
/// Panels in a row.
const COLUMNS: usize = 4;

/// One question's part of the picture.
pub(super) struct Panel<'a> {
    /// The best answer.
    pub(super) answer: &'a EdgeAnswer,
    /// Cosine of each Gaussian with the question; NaN where it has no embedding.
    pub(super) cosines: Vec<f32>,
    /// Cosine from which a Gaussian matches.
    pub(super) threshold: f32,
}

/// Draws the panels, left to right, top to bottom.
///
/// # Errors
/// [`RasterError`].
pub(super) fn draw(
    scene: &Gaussians,
    views: &[RasterView],
    panels: &[Panel<'_>],
) -> Result<RgbImage, RasterError> {
    let Some(first) = views.first() else { return Ok(RgbImage::new(1, 1)) };
    let size = first.intrinsics.scaled_to_width(PANEL_WIDTH_PX);
    let n_rows = panels.len().div_ceil(COLUMNS).max(1) as u32;
    let mut picture =
        RgbImage::from_pixel(size.width_px * COLUMNS as u32, size.height_px * n_rows, image::Rgb([255; 3]));
    for (i, panel) in panels.iter().enumerate() {
        let mut coloured = scene.clone();
        for (sh, cosine) in coloured.sh_dc.iter_mut().zip(&panel.cosines) {
            // NaN compares false: what was never seen stays grey.
            if *cosine >= panel.threshold {
                continue;
            }
            let rgb = sh.map(|c| 0.5 + SH_C0 * c);
            // Luma (BT.601), lightened so that dark furniture still shows its shape.
            let grey = 0.35 + 0.5 * (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]);
            *sh = [(grey - 0.5) / SH_C0; 3];
        }
        let view = best_view(views, panel.answer);
        let view = RasterView { intrinsics: view.intrinsics.scaled_to_width(PANEL_WIDTH_PX), ..view };
        let drawn = to_image(&CpuRasterizer.draw(&coloured, &view, [0.0; 3])?, &view);
        let (column, row) = (i % COLUMNS, i / COLUMNS);
        imageops::replace(
            &mut picture,
            &drawn,
            (column as u32 * size.width_px).into(),
            (row as u32 * size.height_px).into(),
        );
    }
    Ok(picture)
}

/// Returns the view that has an answer nearest to its middle, in front of it.
fn best_view(views: &[RasterView], answer: &EdgeAnswer) -> RasterView {
    let off_axis = |view: &RasterView| {
        let in_camera = view.camera_from_world.transform_point3(answer.position_in_world);
        // Nearer than this an object does not fit the picture.
        if in_camera.z < 1.5 { f64::INFINITY } else { in_camera.truncate().length() / in_camera.z }
    };
    *views.iter().min_by(|a, b| off_axis(a).total_cmp(&off_axis(b))).expect("there are views")
}
