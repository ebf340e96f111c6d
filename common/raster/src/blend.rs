//! Front-to-back blending of the Gaussians of a tile.

use bytemuck::{cast, cast_slice, cast_slice_mut};
use pulp::Simd;
use slag_math::simd::{InstructionSet, Work};

use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE_SIZE_PX};
use crate::project::ScreenGaussian;
use crate::simd::Lanes;

/// Gaussians fetched and prepared at once. Between batches, rows whose pixels are all opaque are skipped.
const BATCH: usize = 32;

/// Largest exponent that matters: `exp(-6)` is below 1/255, so alpha is too small beyond it.
pub const MAX_POWER: f32 = 6.0;
/// Polynomial for `exp(t - 3/4)` with `|t| <= 3/4`, interpolated at the Chebyshev nodes. Its fourth power has a
/// relative error of at most 1.6e-7.
pub const EXP_OF_MINUS_C: [f32; 8] = [
    0.472_366_54,
    0.472_366_55,
    0.236_183_8,
    0.078_727_82,
    0.019_677_254,
    0.003_935_868_3,
    0.000_669_358_36,
    0.000_095_198_29,
];

pub type PerPixel<T> = [[T; TILE_SIZE_PX]; TILE_SIZE_PX];

/// Position of a tile, and its pixels inside the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileRect {
    pub x_px: usize,
    pub y_px: usize,
    /// Columns inside the image.
    pub width_px: usize,
    /// Rows inside the image.
    pub height_px: usize,
}

impl TileRect {
    pub fn new(column: usize, row: usize, image_width_px: usize, image_height_px: usize) -> Self {
        let (x_px, y_px) = (column * TILE_SIZE_PX, row * TILE_SIZE_PX);
        Self {
            x_px,
            y_px,
            width_px: TILE_SIZE_PX.min(image_width_px - x_px),
            height_px: TILE_SIZE_PX.min(image_height_px - y_px),
        }
    }
}

/// Consumes the weights of a tile's Gaussians, near to far. `member` is an index into the visible Gaussians.
pub trait WeightSink {
    /// Consumes the weights at the pixels of vector `v` in row `y`; 0 means no weight.
    fn add<S: Lanes>(&mut self, simd: S, member: u32, y: usize, v: usize, weights: S::f32s);
    fn end<S: Lanes>(&mut self, simd: S, member: u32);
}

/// Blends the Gaussians of a tile and returns the remaining transmittance at each pixel.
pub fn walk_tile(
    instructions: InstructionSet,
    visible: &[ScreenGaussian],
    members: &[u32],
    rect: TileRect,
    sink: &mut impl WeightSink,
) -> PerPixel<f32> {
    instructions.dispatch(Walk { visible, members, rect, sink })
}

struct Walk<'a, K> {
    visible: &'a [ScreenGaussian],
    members: &'a [u32],
    rect: TileRect,
    sink: &'a mut K,
}

impl<S: Lanes, K: WeightSink> Work<S> for Walk<'_, K> {
    type Output = PerPixel<f32>;

    #[inline(always)]
    fn run(self, simd: S) -> PerPixel<f32> {
        let Self { visible, members, rect, sink } = self;
        // A negative value marks an opaque pixel: it saves a second array, and fails every comparison below.
        let mut transmittance = [[-1.0_f32; TILE_SIZE_PX]; TILE_SIZE_PX];
        for row in &mut transmittance[..rect.height_px] {
            row[..rect.width_px].fill(1.0);
        }
        let mut fetched = [ScreenGaussian::default(); BATCH];
        let mut ready = [InTile::default(); BATCH];
        for batch in members.chunks(BATCH) {
            let mut live = [false; TILE_SIZE_PX];
            for y in 0..rect.height_px {
                for light in transmittance[y] {
                    live[y] |= light > 0.0;
                }
            }
            if live == [false; TILE_SIZE_PX] {
                break;
            }
            // Copies all Gaussians before using any, so that cache misses overlap.
            for (fetched, &member) in fetched.iter_mut().zip(batch) {
                *fetched = visible[member as usize];
            }
            for (ready, fetched) in ready.iter_mut().zip(&fetched[..batch.len()]) {
                *ready = InTile::new(fetched, rect);
            }
            for (local, &member) in ready.iter().zip(batch) {
                for y in local.first_row..local.end_row {
                    if !live[y] {
                        continue;
                    }
                    let Some((first, end)) = local.vectors::<S>(y) else { continue };
                    let row: &mut [S::f32s] = cast_slice_mut(&mut transmittance[y]);
                    for (light, v) in row[first..end].iter_mut().zip(first..) {
                        let weights = local.blend(simd, y, v, light);
                        sink.add(simd, member, y, v, weights);
                    }
                }
                sink.end(simd, member);
            }
        }
        for row in &mut transmittance {
            for light in row {
                *light = light.abs();
            }
        }
        transmittance
    }
}

/// A Gaussian relative to a tile: coordinates are small there, so `f32` loses little.
#[derive(Clone, Copy, Default)]
struct InTile {
    /// `u` at the centre of the tile's first pixel.
    u0: f32,
    /// Step of `u` per pixel to the right.
    u_x: f32,
    /// Step of `u` per pixel down.
    u_y: f32,
    /// `v` at the centre of the tile's first pixel.
    v0: f32,
    /// Step of `v` per pixel down.
    v_y: f32,
    /// 1 / `u_x`, pixels.
    width: f32,
    reach2: f32,
    opacity: f32,
    first_row: usize,
    end_row: usize,
}

impl InTile {
    #[inline(always)]
    fn new(gaussian: &ScreenGaussian, rect: TileRect) -> Self {
        let dx = rect.x_px as f64 + 0.5 - gaussian.mean_px.x;
        let dy = rect.y_px as f64 + 0.5 - gaussian.mean_px.y;
        let [top, bottom] = gaussian.y_range_px().map(|y| y - rect.y_px as f64);
        let rows = ScreenGaussian::pixels_within(top, bottom, rect.height_px as u32);
        let (first_row, end_row) = rows.map_or((0, 0), |(a, b)| (a as usize, b as usize + 1));
        Self {
            u0: (gaussian.inv_width * (dx - gaussian.slope * dy)) as f32,
            u_x: gaussian.inv_width as f32,
            u_y: (-gaussian.inv_width * gaussian.slope) as f32,
            v0: (gaussian.inv_height * dy) as f32,
            v_y: gaussian.inv_height as f32,
            width: (gaussian.inv_width as f32).recip(),
            reach2: gaussian.reach2,
            opacity: gaussian.opacity,
            first_row,
            end_row,
        }
    }

    /// Returns the vectors `first..end` of a row that the footprint may touch.
    #[inline(always)]
    fn vectors<S: Simd>(&self, y: usize) -> Option<(usize, usize)> {
        let n_lanes = S::F32_LANES;
        if n_lanes >= TILE_SIZE_PX {
            return Some((0, 1));
        }
        let v = self.v0 + self.v_y * y as f32;
        let left = self.reach2 - v * v;
        if left < 0.0 {
            return None;
        }
        let middle = -(self.u0 + self.u_y * y as f32) * self.width;
        let half = left.sqrt() * self.width;
        // Truncation is a single instruction; `ceil` may be a call. One column too many is harmless.
        let first = (middle - half + 0.999).max(0.0) as i32;
        let last = (middle + half).min((TILE_SIZE_PX - 1) as f32);
        let touches = last >= 0.0 && first <= last as i32;
        touches.then_some((first as usize / n_lanes, last as usize / n_lanes + 1))
    }

    #[inline(always)]
    fn blend<S: Simd>(&self, simd: S, y: usize, v: usize, transmittance: &mut S::f32s) -> S::f32s {
        const COLUMNS: [f32; TILE_SIZE_PX] =
            [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
        let splat = |value| simd.splat_f32s(value);
        let v_row = self.v0 + self.v_y * y as f32;
        let x = cast_slice::<f32, S::f32s>(&COLUMNS)[v];
        let u = simd.add_f32s(splat(self.u0 + self.u_y * y as f32), simd.mul_f32s(splat(self.u_x), x));
        let power_u = simd.mul_f32s(simd.mul_f32s(splat(0.5), u), u);
        let falloff = exp_of_minus(simd, simd.add_f32s(power_u, splat(0.5 * v_row * v_row)));
        let alpha = simd.min_f32s(simd.mul_f32s(splat(self.opacity), falloff), splat(MAX_ALPHA));
        let counts = simd.greater_than_or_equal_f32s(alpha, splat(MIN_ALPHA));
        let light = *transmittance;
        let next = simd.mul_f32s(light, simd.sub_f32s(splat(1.0), alpha));
        let blends = simd.and_m32s(counts, simd.greater_than_f32s(next, splat(MIN_TRANSMITTANCE)));
        let finished = select(simd, counts, simd.min_f32s(light, simd.sub_f32s(splat(0.0), light)), light);
        *transmittance = select(simd, blends, next, finished);
        select(simd, blends, simd.mul_f32s(alpha, light), splat(0.0))
    }
}

/// `select_f32s` is not always inlined, which costs AVX2 a call with its masks in memory.
#[inline(always)]
fn select<S: Simd>(simd: S, mask: S::m32s, set: S::f32s, unset: S::f32s) -> S::f32s {
    cast(simd.select_u32s(mask, cast(set), cast(unset)))
}

/// Returns `exp(-power)` for `power >= 0` with a relative error below 1e-6; powers above [`MAX_POWER`] are clamped.
///
/// Basic arithmetic instead of the platform's `exp` allows SIMD and gives the same bits everywhere.
#[inline(always)]
fn exp_of_minus<S: Simd>(simd: S, power: S::f32s) -> S::f32s {
    let splat = |value| simd.splat_f32s(value);
    let quarter = simd.mul_f32s(simd.min_f32s(power, splat(MAX_POWER)), splat(0.25));
    let t = simd.sub_f32s(splat(MAX_POWER / 8.0), quarter);
    let [first @ .., last] = EXP_OF_MINUS_C;
    let mut root = splat(last);
    for &c in first.iter().rev() {
        // No fused multiply-add, because not every processor has one.
        root = simd.add_f32s(simd.mul_f32s(root, t), splat(c));
    }
    let square = simd.mul_f32s(root, root);
    simd.mul_f32s(square, square)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Exp<'a>(&'a mut [f32]);

    impl<S: Lanes> Work<S> for Exp<'_> {
        type Output = ();

        #[inline(always)]
        fn run(self, simd: S) {
            for power in cast_slice_mut::<f32, S::f32s>(self.0) {
                *power = exp_of_minus(simd, *power);
            }
        }
    }

    #[test]
    fn exp_is_within_a_millionth_and_has_the_same_bits_for_all_instruction_sets() {
        let powers: Vec<f32> = (0..6000).map(|i| i as f32 / 1000.0).chain([f32::INFINITY; 16]).collect();
        let on = |instructions: InstructionSet| {
            let mut values = powers.clone();
            instructions.dispatch(Exp(&mut values));
            values
        };
        let portable = on(InstructionSet::Portable);
        for (power, found) in powers.iter().zip(&portable).take(6000) {
            let expected = (-f64::from(*power)).exp();
            assert!((f64::from(*found) / expected - 1.0).abs() < 1e-6, "{power}: {found} {expected}");
        }
        assert!(portable[6000] < MIN_ALPHA);
        for set in InstructionSet::available() {
            assert_eq!(on(*set), portable, "{}", set.name());
        }
    }
}
