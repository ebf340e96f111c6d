//! Drawing of colour, depth and coverage.

use bytemuck::cast_slice_mut;
use image::RgbImage;
use rayon::prelude::*;
use slag_math::simd::InstructionSet;

use crate::bin::{Tiles, bin};
use crate::blend::{PerPixel, TileRect, WeightSink, walk_tile};
use crate::buckets::Buckets;
use crate::constants::TILE_SIZE_PX;
use crate::project::{self, PreparedScene, Projection, ScreenGaussian};
use crate::simd::Lanes;
use crate::view::RasterView;

/// The picture of a scene in one view; all arrays are row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Drawing {
    pub width_px: u32,
    pub height_px: u32,
    /// `[height * width][3]`, over the background; at least 0, not limited to 1.
    pub rgb: Vec<f32>,
    /// Expected camera z, weighted by contribution, world units; 0 at pixels without any Gaussian.
    pub depth: Vec<f32>,
    /// Opacity of the scene at the pixel, 0..=1: one minus the transmittance.
    pub coverage: Vec<f32>,
    pub counters: ViewCounters,
}

impl Drawing {
    pub fn image(&self) -> RgbImage {
        let bytes = self.rgb.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        RgbImage::from_raw(self.width_px, self.height_px, bytes).expect("three values per pixel")
    }
}

impl PreparedScene<'_> {
    /// Draws a checked view of a checked scene over a background, on the current rayon pool.
    pub fn draw(&self, instructions: InstructionSet, view: &RasterView, background: [f32; 3]) -> Drawing {
        let projection = self.project(view);
        let tiles = bin(&projection.visible, &view.intrinsics);
        let position_in_world = view.camera_from_world.inverse().translation;
        let colours = project::colours(self.scene, &projection.visible, position_in_world);
        let drawing = draw(instructions, &projection.visible, &colours, &tiles, background);
        Drawing { counters: ViewCounters::of(&projection, &tiles), ..drawing }
    }
}

/// Draws all tiles. `colours`: RGB of each visible Gaussian.
pub fn draw(
    instructions: InstructionSet,
    visible: &[ScreenGaussian],
    colours: &[[f32; 3]],
    tiles: &Tiles,
    background: [f32; 3],
) -> Drawing {
    let (width_px, height_px) = (tiles.width_px as usize, tiles.height_px as usize);
    let n_px = width_px * height_px;
    let mut rgb = vec![0.0; n_px * 3];
    let mut depth = vec![0.0; n_px];
    let mut coverage = vec![0.0; n_px];
    let band_px = width_px * TILE_SIZE_PX;
    (rgb.par_chunks_mut(band_px * 3), depth.par_chunks_mut(band_px), coverage.par_chunks_mut(band_px))
        .into_par_iter()
        .zip(&tiles.rows)
        .enumerate()
        .for_each(|(row, ((rgb, depth, coverage), tile_row))| {
            for (column, members) in tile_row.iter().enumerate() {
                let rect = TileRect::new(column, row, width_px, height_px);
                let mut sink = PixelSink::new(visible, colours);
                let transmittance = walk_tile(instructions, visible, members, rect, &mut sink);
                for (y, light) in transmittance.iter().enumerate().take(rect.height_px) {
                    for (x, &light) in light.iter().enumerate().take(rect.width_px) {
                        let pixel = y * width_px + rect.x_px + x;
                        for c in 0..3 {
                            rgb[pixel * 3 + c] = sink.rgb[c][y][x] + light * background[c];
                        }
                        coverage[pixel] = 1.0 - light;
                        if sink.weight[y][x] > 0.0 {
                            depth[pixel] = sink.depth[y][x] / sink.weight[y][x];
                        }
                    }
                }
            }
        });
    Drawing {
        width_px: tiles.width_px,
        height_px: tiles.height_px,
        rgb,
        depth,
        coverage,
        ..Drawing::default()
    }
}

struct PixelSink<'a> {
    visible: &'a [ScreenGaussian],
    colours: &'a [[f32; 3]],
    rgb: [PerPixel<f32>; 3],
    depth: PerPixel<f32>,
    weight: PerPixel<f32>,
}

impl<'a> PixelSink<'a> {
    fn new(visible: &'a [ScreenGaussian], colours: &'a [[f32; 3]]) -> Self {
        let zero = [[0.0; TILE_SIZE_PX]; TILE_SIZE_PX];
        Self { visible, colours, rgb: [zero; 3], depth: zero, weight: zero }
    }
}

impl WeightSink for PixelSink<'_> {
    #[inline(always)]
    fn add<S: Lanes>(&mut self, simd: S, member: u32, y: usize, v: usize, weights: S::f32s) {
        let member = member as usize;
        let add_scaled = |row: &mut [f32; TILE_SIZE_PX], factor| {
            let sum = &mut cast_slice_mut::<f32, S::f32s>(row)[v];
            *sum = simd.add_f32s(*sum, simd.mul_f32s(weights, simd.splat_f32s(factor)));
        };
        add_scaled(&mut self.weight[y], 1.0);
        add_scaled(&mut self.depth[y], self.visible[member].depth);
        for (plane, &value) in self.rgb.iter_mut().zip(&self.colours[member]) {
            add_scaled(&mut plane[y], value);
        }
    }

    #[inline(always)]
    fn end<S: Lanes>(&mut self, _: S, _: u32) {}
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewCounters {
    /// Gaussians with a pixel of the image in their footprint; they may be occluded.
    pub visible: usize,
    pub pairs: usize,
    /// Not drawable: not finite, without a rotation, or beyond `f32` once projected.
    pub unusable: usize,
}

impl ViewCounters {
    pub fn of(projection: &Projection, tiles: &Tiles) -> Self {
        Self {
            visible: projection.visible.len(),
            pairs: tiles.rows.iter().map(Buckets::n_items).sum(),
            unusable: projection.unusable,
        }
    }
}
