//! Pictures of the answers: each answer's Gaussians in colour and the rest in grey, and a map from above.

use font8x8::{BASIC_FONTS, UnicodeFonts};
use glam::{DVec2, DVec3};
use image::{Rgb, RgbImage, imageops};
use serde::{Deserialize, Serialize};
use slag_common::Gaussians;
use slag_common::frames::Aabb;
use slag_common::gaussians::SH_C0;
use slag_encoder::raster::{CpuRasterizer, RasterError, RasterView, Rasterizer};

const PANEL_WIDTH_PX: u32 = 320;
const N_CANDIDATES: usize = 8;
const COLUMNS: usize = 4;

const BACKGROUND: [f32; 3] = [0.9; 3];

/// Draws the Gaussians at or above the threshold lit, at the view's own size. `cosines`: `[N]`.
fn draw_lit(
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
    Ok(CpuRasterizer.draw(&coloured, view, BACKGROUND)?.image())
}

/// Brightness of a colour (BT.601).
fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

pub(super) struct Panel<'a> {
    pub(super) question: &'a str,
    pub(super) answer: &'a EdgeAnswer,
    /// Cosine of each Gaussian with the question; NaN where it has no embedding.
    pub(super) cosines: Vec<f32>,
    /// Cosine from which a Gaussian matches.
    pub(super) threshold: f32,
}

/// Draws the panels, left to right, top to bottom.
pub(super) fn answers(
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
        let view = best_view(scene, views, panel)?;
        let view = RasterView { intrinsics: view.intrinsics.scaled_to_width(PANEL_WIDTH_PX), ..view };
        let mut drawn = draw_lit(scene, &panel.cosines, panel.threshold, &view)?;
        write_caption(&mut drawn, panel.question);
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

/// Of the views with the answer nearest to their middle, returns the one with the most matching pixels.
fn best_view(scene: &Gaussians, views: &[RasterView], panel: &Panel<'_>) -> Result<RasterView, RasterError> {
    let off_axis = |view: &RasterView| {
        let in_camera = view.camera_from_world.transform_point3(panel.answer.position_in_world);
        // Nearer than this, an object does not fit into the picture.
        if in_camera.z < 1.5 { f64::INFINITY } else { in_camera.truncate().length() / in_camera.z }
    };
    let mut candidates: Vec<&RasterView> = views.iter().collect();
    candidates.sort_by(|a, b| off_axis(a).total_cmp(&off_axis(b)));
    candidates.truncate(N_CANDIDATES);
    // White on black, so that brightness counts pixels. Distant matches are small and hardly count.
    let mut found = scene.clone();
    for (sh, cosine) in found.sh_dc.iter_mut().zip(&panel.cosines) {
        *sh = [if *cosine >= panel.threshold { 0.5 } else { -0.5 } / SH_C0; 3];
    }
    let shown = |view: &RasterView| -> Result<f64, RasterError> {
        let view = RasterView { intrinsics: view.intrinsics.scaled_to_width(PANEL_WIDTH_PX / 4), ..*view };
        let drawn = CpuRasterizer.draw(&found, &view, [0.0; 3])?;
        Ok(drawn.rgb.iter().map(|c| f64::from(*c)).sum())
    };
    let mut best = (*candidates.first().expect("there are views"), f64::NEG_INFINITY);
    for view in candidates {
        let pixels = shown(view)?;
        if pixels > best.1 {
            best = (view, pixels);
        }
    }
    Ok(*best.0)
}

const MAP_PX_PER_M: f64 = 48.0;
/// The map leaves out Gaussians above this height, such as ceilings and lamps.
const MAP_HEIGHT_M: f64 = 2.2;
const MARGIN_M: f64 = 0.5;

/// Draws the scene from above: cells that the robot fetched in colour with their borders, other cells in grey, a
/// cross at the robot with a circle of `radius_m` around it, and a small ring at each answer.
pub(super) fn map(
    scene: &Gaussians,
    cells: &[Aabb],
    answers: &[DVec3],
    robot_in_world: DVec3,
    radius_m: f64,
) -> RgbImage {
    let mut map = Map::of(cells);
    let is_fetched = |bounds: &Aabb| bounds.distance_to(robot_in_world) <= radius_m;
    let fetched: Vec<&Aabb> = cells.iter().filter(|bounds| is_fetched(bounds)).collect();
    let mut order: Vec<usize> =
        (0..scene.len()).filter(|i| scene.means_in_world[*i].z < MAP_HEIGHT_M).collect();
    order.sort_by(|a, b| scene.means_in_world[*a].z.total_cmp(&scene.means_in_world[*b].z));
    for i in order {
        let mean = scene.means_in_world[i];
        let rgb = scene.rgb_dc(i);
        let on_board = fetched.iter().any(|bounds| bounds.distance_to(mean) == 0.0);
        let grey = 0.6 + 0.3 * luma(rgb);
        let rgb = if on_board { rgb } else { [grey; 3] }.map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8);
        let (x, y) = map.place(mean.truncate());
        let reach = (f64::from(scene.scales[i][0]) * MAP_PX_PER_M).ceil() as i64;
        (-reach..=reach).for_each(|dy| (-reach..=reach).for_each(|dx| map.put((x + dx, y + dy), rgb)));
    }
    for bounds in fetched {
        let ((x0, y1), (x1, y0)) = (map.place(bounds.min.truncate()), map.place(bounds.max.truncate()));
        (x0..=x1).for_each(|x| [y0, y1].into_iter().for_each(|y| map.put((x, y), [30, 90, 200])));
        (y0..=y1).for_each(|y| [x0, x1].into_iter().for_each(|x| map.put((x, y), [30, 90, 200])));
    }
    map.ring(robot_in_world, radius_m, [0, 0, 0]);
    for answer in answers {
        [0.14, 0.17, 0.2].into_iter().for_each(|radius_m| map.ring(*answer, radius_m, [230, 0, 80]));
    }
    let (x, y) = map.place(robot_in_world.truncate());
    for step in -9..=9 {
        let cross = [(step, 0), (step, 1), (0, step), (1, step)];
        cross.into_iter().for_each(|(dx, dy)| map.put((x + dx, y + dy), [0, 0, 0]));
    }
    map.image
}

struct Map {
    image: RgbImage,
    /// The corner of the cells at the bottom left.
    low: DVec2,
}

impl Map {
    fn of(cells: &[Aabb]) -> Self {
        let mut low = DVec2::INFINITY;
        let mut high = DVec2::NEG_INFINITY;
        for cell in cells {
            (low, high) = (low.min(cell.min.truncate()), high.max(cell.max.truncate()));
        }
        let size = ((high - low + 2.0 * MARGIN_M) * MAP_PX_PER_M).max(DVec2::ONE);
        Self { image: RgbImage::from_pixel(size.x as u32, size.y as u32, Rgb([250; 3])), low }
    }

    fn place(&self, at: DVec2) -> (i64, i64) {
        let at = (at - self.low + MARGIN_M) * MAP_PX_PER_M;
        (at.x as i64, i64::from(self.image.height()) - 1 - at.y as i64)
    }

    fn put(&mut self, (x, y): (i64, i64), rgb: [u8; 3]) {
        let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y)) else { return };
        if let Some(pixel) = self.image.get_pixel_mut_checked(x, y) {
            *pixel = Rgb(rgb);
        }
    }

    fn ring(&mut self, centre: DVec3, radius_m: f64, rgb: [u8; 3]) {
        for step in 0..4000 {
            let angle = std::f64::consts::TAU * f64::from(step) / 4000.0;
            let (x, y) = self.place(centre.truncate() + radius_m * DVec2::new(angle.cos(), angle.sin()));
            [(0, 0), (1, 0), (0, 1), (1, 1)].into_iter().for_each(|(dx, dy)| self.put((x + dx, y + dy), rgb));
        }
    }
}

const GLYPH: u32 = 8;
/// Pixels of the picture per pixel of the font, along each axis.
const SCALE: u32 = 2;
/// Space around the text and between its lines, pixels of the picture.
const MARGIN_PX: u32 = 6;
const INK: Rgb<u8> = Rgb([20; 3]);

/// Writes a text on a light band across the top of a picture, in as many lines as it needs.
fn write_caption(picture: &mut RgbImage, text: &str) {
    let (width, height) = picture.dimensions();
    let n_columns = width.saturating_sub(2 * MARGIN_PX) / (GLYPH * SCALE);
    let lines = lines(text, n_columns.max(1) as usize);
    let pitch_px = GLYPH * SCALE + MARGIN_PX;
    let band_px = (lines.len() as u32 * pitch_px + MARGIN_PX).min(height);
    for pixel in picture.pixels_mut().take((width * band_px) as usize) {
        // A fifth of the picture shows through.
        pixel.0 = pixel.0.map(|c| 255 - (255 - c) / 5);
    }
    for (row, line) in lines.iter().enumerate() {
        for (column, character) in line.chars().enumerate() {
            let left = MARGIN_PX + column as u32 * GLYPH * SCALE;
            glyph(picture, character, left, MARGIN_PX + row as u32 * pitch_px);
        }
    }
}

/// Draws a character; one that the font lacks becomes a question mark. Pixels outside the picture are dropped.
fn glyph(picture: &mut RgbImage, character: char, left: u32, top: u32) {
    let rows = BASIC_FONTS.get(character).or_else(|| BASIC_FONTS.get('?')).unwrap_or_default();
    for (y, x) in (0..GLYPH * SCALE).flat_map(|y| (0..GLYPH * SCALE).map(move |x| (y, x))) {
        // The lowest bit of a row is its leftmost pixel.
        let is_set = rows[(y / SCALE) as usize] >> (x / SCALE) & 1 == 1;
        if let (true, Some(pixel)) = (is_set, picture.get_pixel_mut_checked(left + x, top + y)) {
            *pixel = INK;
        }
    }
}

/// Breaks a text between words into lines of at most `n_columns` characters; a longer word has a line of its own.
fn lines(text: &str, n_columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= n_columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct EdgeAnswer {
    pub position_in_world: DVec3,
    /// Edge lengths of its box.
    pub size: DVec3,
    pub score: f32,
    pub n_gaussians: u64,
    pub distance: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_between_words() {
        assert_eq!(lines("something to move things with", 19), ["something to move", "things with"]);
        assert_eq!(lines("a refrigerator", 4), ["a", "refrigerator"]);
        assert_eq!(lines("", 4), [""; 0]);
    }

    /// By hand: the font's slash, its upper end at the right; the picture below the band is unchanged.
    #[test]
    fn captions_are_legible() {
        let slash =
            [".....##.", "....##..", "...##...", "..##....", ".##.....", "##......", "#.......", "........"];
        let mut picture = RgbImage::from_pixel(320, 240, Rgb([100; 3]));
        write_caption(&mut picture, "a /");
        for (y, row) in slash.iter().enumerate() {
            for (x, cell) in row.chars().enumerate() {
                let (left, top) = (MARGIN_PX + 2 * GLYPH * SCALE, MARGIN_PX);
                let found = picture.get_pixel(left + x as u32 * SCALE, top + y as u32 * SCALE);
                assert_eq!(*found == INK, cell == '#', "column {x}, row {y}");
            }
        }
        assert_eq!((picture.get_pixel(319, 27).0, picture.get_pixel(319, 28).0), ([224; 3], [100; 3]));
        // A picture smaller than its caption.
        write_caption(&mut RgbImage::new(7, 5), "where is the refrigerator");
    }
}
