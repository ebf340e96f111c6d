//! Blends the Gaussians of a tile front to back, and sums their weights over regions.

use glam::Vec4;
use rayon::prelude::*;

use super::RegionWeight;
use super::bin::Tiles;
use super::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, SUM_FRACTION_BITS, TILE_SIZE_PX};
use super::project::ScreenGaussian;
use super::{WeightKind, WeightKind::Blend, WeightKind::Falloff};
use crate::segment::{NO_REGION, RegionMap};

/// Pixels of a row that are worked on at once, as two SIMD vectors of four.
pub const LANES: usize = 8;
/// Gaussians between two looks at which rows of a tile are finished.
const LIVENESS_INTERVAL: usize = 16;

/// Powers up to here matter: `exp(-6)` is below 1/255, so that no alpha beyond counts.
pub const MAX_POWER: f32 = 6.0;
/// `exp(t - 3/4)` for `|t| <= 3/4`, interpolated at the Chebyshev nodes; its 4th power is within
/// 1.6e-7 of the exact one.
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

/// One value for each pixel of a tile.
pub type PerPixel<T> = [[T; TILE_SIZE_PX]; TILE_SIZE_PX];

/// Where a tile lies; its pixels inside the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileRect {
    /// Left edge, pixels.
    pub x_px: usize,
    /// Top edge, pixels.
    pub y_px: usize,
    /// Columns inside the image.
    pub width_px: usize,
    /// Rows inside the image.
    pub height_px: usize,
}

impl TileRect {
    /// Returns the tile in a column and row of the grid over an image.
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

/// Takes the weights of a tile's Gaussians, near to far; `member` indexes the visible ones.
pub trait WeightSink {
    /// Takes the weights at pixels `x..x + LANES` of row `y`; 0 where it has none.
    fn lanes(&mut self, member: u32, x: usize, y: usize, weights: &[f32; LANES]);
    /// Ends a Gaussian.
    fn end(&mut self, member: u32);
}

/// Walks the Gaussians of a tile and returns the transmittance left at each pixel.
///
/// With [`Falloff`] nothing hides anything and the transmittance stays 1.
pub fn walk_tile(
    visible: &[ScreenGaussian],
    members: &[u32],
    rect: TileRect,
    kind: WeightKind,
    sink: &mut impl WeightSink,
) -> PerPixel<f32> {
    match kind {
        Blend => walk::<true>(visible, members, rect, sink),
        Falloff => walk::<false>(visible, members, rect, sink),
    }
}

fn walk<const BLEND: bool>(
    visible: &[ScreenGaussian],
    members: &[u32],
    rect: TileRect,
    sink: &mut impl WeightSink,
) -> PerPixel<f32> {
    // Negative means finished: the sign bit costs no second array, and fails every comparison below.
    let mut transmittance = [[-1.0_f32; TILE_SIZE_PX]; TILE_SIZE_PX];
    for row in &mut transmittance[..rect.height_px] {
        row[..rect.width_px].fill(1.0);
    }
    let mut live = [false; TILE_SIZE_PX];
    for (turn, &member) in members.iter().enumerate() {
        if turn % LIVENESS_INTERVAL == 0 {
            for (live, row) in live.iter_mut().zip(&transmittance) {
                *live = row.iter().any(|&light| light > 0.0);
            }
            if !live.contains(&true) {
                break;
            }
        }
        let gaussian = &visible[member as usize];
        let local = InTile::new(gaussian, rect);
        for y in local.first_row..local.end_row {
            if !live[y] {
                continue;
            }
            let Some((first, last)) = local.columns(y, rect.width_px) else { continue };
            let (start, end) =
                if last - first < LANES { (first.min(TILE_SIZE_PX - LANES), 1) } else { (0, 2) };
            for block in 0..end {
                let x = start + block * LANES;
                let Some(lanes) = transmittance[y][x..].first_chunk_mut::<LANES>() else { continue };
                let weights = local.blend::<BLEND>(x, y, lanes);
                sink.lanes(member, x, y, &weights);
            }
        }
        sink.end(member);
    }
    transmittance.map(|row| row.map(f32::abs))
}

/// A Gaussian relative to a tile, in `f32`: coordinates are small there, so little is lost.
struct InTile {
    /// `u` at the centre of the tile's first pixel.
    u0: f32,
    /// Step of `u` a pixel right.
    u_x: f32,
    /// Step of `u` a pixel down.
    u_y: f32,
    /// `v` at the centre of the tile's first pixel.
    v0: f32,
    /// Step of `v` a pixel down.
    v_y: f32,
    /// 1 / `u_x`, pixels.
    width: f32,
    reach2: f32,
    opacity: f32,
    first_row: usize,
    end_row: usize,
}

impl InTile {
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

    /// Returns the first and last column of a row that the footprint may touch.
    fn columns(&self, y: usize, width_px: usize) -> Option<(usize, usize)> {
        let v = self.v0 + self.v_y * y as f32;
        let left = self.reach2 - v * v;
        if left < 0.0 {
            return None;
        }
        let middle = -(self.u0 + self.u_y * y as f32) * self.width;
        let half = left.sqrt() * self.width;
        // Rounded by truncation, which is an instruction where `ceil` may be a call; a column too many
        // does no harm.
        let first = (middle - half + 0.999).max(0.0) as i32;
        let last = (middle + half).min((width_px - 1) as f32);
        (last >= 0.0 && first <= last as i32).then_some((first as usize, last as usize))
    }

    /// Returns the weights at pixels `x..x + LANES` of row `y` and takes their light.
    #[inline(always)]
    fn blend<const BLEND: bool>(&self, x: usize, y: usize, transmittance: &mut [f32; LANES]) -> [f32; LANES] {
        let v = self.v0 + self.v_y * y as f32;
        let (u_row, power_v) = (self.u0 + self.u_y * y as f32, Vec4::splat(0.5 * v * v));
        let mut weights = [0.0; LANES];
        for half in [0, 4] {
            let x = Vec4::splat((x + half) as f32) + Vec4::new(0.0, 1.0, 2.0, 3.0);
            let u = Vec4::splat(u_row) + Vec4::splat(self.u_x) * x;
            let falloff = exp_of_minus(0.5 * u * u + power_v);
            let alpha = (self.opacity * falloff).min(Vec4::splat(MAX_ALPHA));
            let counts = alpha.cmpge(Vec4::splat(MIN_ALPHA));
            let light = Vec4::from_slice(&transmittance[half..]);
            let weight = if BLEND {
                let next = light * (Vec4::ONE - alpha);
                let blends = counts & next.cmpgt(Vec4::splat(MIN_TRANSMITTANCE));
                let finished = Vec4::select(counts, -light.abs(), light);
                Vec4::select(blends, next, finished).write_to_slice(&mut transmittance[half..]);
                Vec4::select(blends, alpha * light, Vec4::ZERO)
            } else {
                Vec4::select(counts & light.cmpgt(Vec4::ZERO), falloff, Vec4::ZERO)
            };
            weight.write_to_slice(&mut weights[half..]);
        }
        weights
    }
}

/// Returns `exp(-power)` for `power >= 0`, within 1e-6 of the result; beyond [`MAX_POWER`] stays there.
///
/// Plain arithmetic instead of the platform's `exp`: fits SIMD, and has the same bits everywhere.
#[inline(always)]
fn exp_of_minus(power: Vec4) -> Vec4 {
    let t = Vec4::splat(MAX_POWER / 8.0) - power.min(Vec4::splat(MAX_POWER)) * 0.25;
    let [first @ .., last] = EXP_OF_MINUS_C;
    let root = first.iter().rev().fold(Vec4::splat(last), |sum, &c| sum * t + c);
    let square = root * root;
    square * square
}

/// A Gaussian's sum over the pixels of a region in one tile, or in all of them.
#[derive(Clone, Copy)]
pub struct Sum {
    /// Index into the visible Gaussians.
    member: u32,
    region: u32,
    /// In units of `2^-SUM_FRACTION_BITS`, so that adding is exact in any order.
    fixed: u64,
}

/// Returns the sums of each tile that has a region.
pub fn tile_sums(
    visible: &[ScreenGaussian],
    tiles: &Tiles,
    regions: &RegionMap,
    kind: WeightKind,
) -> Vec<Vec<Sum>> {
    let (width_px, height_px) = (tiles.width_px as usize, tiles.height_px as usize);
    tiles
        .rows
        .par_iter()
        .enumerate()
        .flat_map_iter(|(row, tile_row)| {
            tile_row.tiles().enumerate().filter_map(move |(column, members)| {
                let mut sink = RegionSink::new(regions, TileRect::new(column, row, width_px, height_px))?;
                walk_tile(visible, members, sink.rect, kind, &mut sink);
                Some(sink.sums)
            })
        })
        .collect()
}

/// Adds up the sums of all tiles; returns those above zero, ordered by (Gaussian, region).
pub fn merge(visible: &[ScreenGaussian], sums: &[Vec<Sum>]) -> Vec<RegionWeight> {
    // A counting pass brings each Gaussian's few sums together; only those need sorting.
    let mut ends = vec![0_usize; visible.len()];
    for sum in sums.iter().flatten() {
        ends[sum.member as usize] += 1;
    }
    let mut n_sums = 0;
    for end in &mut ends {
        n_sums += *end;
        *end = n_sums - *end;
    }
    let mut by_member = vec![(0_u32, 0_u64); n_sums];
    for sum in sums.iter().flatten() {
        let end = &mut ends[sum.member as usize];
        by_member[*end] = (sum.region, sum.fixed);
        *end += 1;
    }
    let mut entries = Vec::new();
    let mut start = 0;
    for (on_screen, &end) in visible.iter().zip(&ends) {
        let of_gaussian = &mut by_member[start..end];
        of_gaussian.sort_unstable_by_key(|&(region, _)| region);
        for same in of_gaussian.chunk_by(|a, b| a.0 == b.0) {
            let fixed: u64 = same.iter().map(|&(_, fixed)| fixed).sum();
            if fixed > 0 {
                let weight = (fixed as f64 * 2.0_f64.powi(-SUM_FRACTION_BITS)) as f32;
                entries.push(RegionWeight { gaussian: on_screen.gaussian, region: same[0].0, weight });
            }
        }
        start = end;
    }
    entries
}

/// Adds weights up per region of a tile.
struct RegionSink {
    rect: TileRect,
    /// Index into `regions` of each pixel.
    slot_of_pixel: PerPixel<u16>,
    /// End of the run of equal slots that starts at a pixel, within its row.
    run_end: PerPixel<u8>,
    /// Regions of the tile; [`NO_REGION`] may be one of them.
    regions: Vec<u32>,
    /// Weight of the current Gaussian per region: sums of up to 256 `f32` weights, which `f64` holds
    /// with hardly any rounding, so that sums over regions add up.
    weights: Vec<f64>,
    /// Slots whose weight is not 0.
    touched: Vec<u16>,
    sums: Vec<Sum>,
}

impl RegionSink {
    /// Relabels the regions of a tile; `None` if no pixel has one.
    fn new(map: &RegionMap, rect: TileRect) -> Option<Self> {
        let mut regions: Vec<u32> = Vec::new();
        let mut slot_of_pixel = [[0; TILE_SIZE_PX]; TILE_SIZE_PX];
        let mut run_end = [[TILE_SIZE_PX as u8; TILE_SIZE_PX]; TILE_SIZE_PX];
        let row_of = |y: usize| {
            let start = (rect.y_px + y) * map.width_px as usize + rect.x_px;
            &map.region_of_pixel[start..start + rect.width_px]
        };
        (0..rect.height_px).for_each(|y| regions.extend_from_slice(row_of(y)));
        regions.sort_unstable();
        regions.dedup();
        if regions == [NO_REGION] {
            return None;
        }
        for y in 0..rect.height_px {
            let (slots, ends) = (&mut slot_of_pixel[y], &mut run_end[y]);
            for (slot, region) in slots.iter_mut().zip(row_of(y)) {
                *slot = regions.partition_point(|r| r < region) as u16;
            }
            // Beyond the image every weight is 0: those pixels belong to any run.
            for x in (0..rect.width_px.saturating_sub(1)).rev() {
                ends[x] = if slots[x] == slots[x + 1] { ends[x + 1] } else { x as u8 + 1 };
            }
        }
        let weights = vec![0.0; regions.len()];
        Some(Self { rect, slot_of_pixel, run_end, regions, weights, touched: Vec::new(), sums: Vec::new() })
    }

    #[inline(always)]
    fn add(&mut self, slot: u16, weight: f64) {
        let total = &mut self.weights[usize::from(slot)];
        if *total == 0.0 {
            self.touched.push(slot);
        }
        *total += weight;
    }
}

impl WeightSink for RegionSink {
    #[inline(always)]
    fn lanes(&mut self, _: u32, x: usize, y: usize, weights: &[f32; LANES]) {
        if usize::from(self.run_end[y][x]) >= x + LANES {
            let w = weights.map(f64::from);
            let total = ((w[0] + w[4]) + (w[2] + w[6])) + ((w[1] + w[5]) + (w[3] + w[7]));
            if total > 0.0 {
                self.add(self.slot_of_pixel[y][x], total);
            }
        } else {
            for (i, &weight) in weights.iter().enumerate() {
                if weight > 0.0 {
                    self.add(self.slot_of_pixel[y][x + i], f64::from(weight));
                }
            }
        }
    }

    fn end(&mut self, member: u32) {
        let Self { weights, regions, touched, sums, .. } = self;
        for slot in touched.drain(..) {
            let weight = std::mem::take(&mut weights[usize::from(slot)]);
            let region = regions[usize::from(slot)];
            if region != NO_REGION {
                let fixed = (weight * 2.0_f64.powi(SUM_FRACTION_BITS)).round() as u64;
                sums.push(Sum { member, region, fixed });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::DVec2;
    use slag_common::{Distortion, Intrinsics};

    use super::super::bin::bin;
    use super::*;

    #[test]
    fn exp_is_within_a_millionth() {
        for i in 0..=6000 {
            let power = i as f32 / 1000.0;
            let found = f64::from(exp_of_minus(Vec4::splat(power)).x);
            let expected = (-f64::from(power)).exp();
            assert!((found / expected - 1.0).abs() < 1e-6, "{power}: {found} {expected}");
        }
        assert!(exp_of_minus(Vec4::splat(f32::INFINITY)).x < MIN_ALPHA);
    }

    /// Sums of whole pixels must differ by no more than the rounding of each part to 2^-32, or masks,
    /// which are unions of regions, would depend on how other masks cut them.
    #[test]
    fn fixed_point_sums_add_up_within_their_last_bit() {
        let (width_px, height_px) = (48, 32);
        let camera = Intrinsics {
            width_px,
            height_px,
            focal_x_px: 1.0,
            focal_y_px: 1.0,
            centre_x_px: 0.0,
            centre_y_px: 0.0,
            distortion: Distortion::None,
        };
        let visible: Vec<ScreenGaussian> = (0..200_u32)
            .map(|i| ScreenGaussian {
                gaussian: i,
                depth: 1.0 + i as f32,
                opacity: 0.3,
                reach2: 8.7,
                mean_px: DVec2::new(f64::from(i * 7 % 48) + 0.3, f64::from(i * 11 % 32) + 0.1),
                inv_width: 1.0 / (1.0 + f64::from(i % 9)),
                slope: 0.1 * f64::from(i % 5),
                inv_height: 1.0 / (1.0 + f64::from(i % 13)),
            })
            .collect();
        let tiles = bin(&visible, &camera);
        let sums_of = |n_regions: u32, region: fn(u32) -> u32| {
            let region_of_pixel = (0..width_px * height_px).map(region).collect();
            let regions = RegionMap { width_px, height_px, region_of_pixel, n_regions };
            let mut sums = BTreeMap::<u32, (u64, u64)>::new();
            for sum in tile_sums(&visible, &tiles, &regions, Blend).into_iter().flatten() {
                let (fixed, n_parts) = sums.entry(sum.member).or_default();
                *fixed += sum.fixed;
                *n_parts += 1;
            }
            sums
        };
        let whole = sums_of(1, |_| 0);
        let parts = sums_of(5, |pixel| pixel % 5);
        assert!(parts.values().any(|sum| sum.1 > 20) && whole.len() == parts.len());
        for (whole, parts) in whole.values().zip(parts.values()) {
            assert!(whole.0.abs_diff(parts.0) <= whole.1 + parts.1, "{whole:?} {parts:?}");
        }
    }
}
