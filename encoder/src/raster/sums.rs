//! Sums the weights of Gaussians over regions: per tile, then over all tiles.

use bytemuck::{Zeroable, cast, cast_slice, cast_slice_mut};
use rayon::prelude::*;

use super::bin::Tiles;
use super::blend::{TileRect, WeightSink, walk_tile};
use super::buckets::{Buckets, concat};
use super::constants::{MIN_ALPHA, MIN_TRANSMITTANCE, SUM_FRACTION_BITS, TILE_SIZE_PX};
use super::project::ScreenGaussian;
use super::simd::{Lanes, Level};
use super::{RegionWeight, WeightKind};
use crate::masks::{NO_REGION, RegionMap};

/// Steps of the fixed-point sums in 1.
const SUM_STEPS: f64 = (1_u64 << SUM_FRACTION_BITS) as f64;

/// Sums of a tile's weights in `f64` are exact, whatever the order: a weight is at least 2^-22, so it
/// is a multiple of 2^-45, and 256 of them stay within 53 bits.
const _: () = {
    assert!(MIN_ALPHA as f64 * MIN_TRANSMITTANCE as f64 > 1.0 / (1 << 22) as f64);
    assert!(TILE_SIZE_PX * TILE_SIZE_PX <= 1 << 8);
};

/// A Gaussian's sum over the pixels of a region in one tile, or in all of them.
#[derive(Clone, Copy, Zeroable)]
pub struct Sum {
    /// Index into the visible Gaussians.
    member: u32,
    region: u32,
    /// In units of `2^-SUM_FRACTION_BITS`, so that adding is exact in any order.
    fixed: u64,
}

/// Visible Gaussians that one task of [`merge`] brings together: their counts fit the cache.
const RANGE: usize = 1 << 13;

/// Returns the sums of all tiles: a part a row of tiles, a bucket for each range of Gaussians.
pub fn tile_sums(
    visible: &[ScreenGaussian],
    tiles: &Tiles,
    regions: &RegionMap,
    kind: WeightKind,
    level: Level,
) -> Vec<Buckets<Sum>> {
    let (width_px, height_px) = (tiles.width_px as usize, tiles.height_px as usize);
    tiles
        .rows
        .par_iter()
        .enumerate()
        .map(|(row, tile_row)| {
            let members: Vec<&[u32]> = tile_row.iter().collect();
            let sums: Vec<Vec<Sum>> = members
                .into_par_iter()
                .enumerate()
                .filter_map(|(column, members)| {
                    let rect = TileRect::new(column, row, width_px, height_px);
                    let mut sink = RegionSink::new(regions, rect)?;
                    walk_tile(level, visible, members, rect, kind, &mut sink);
                    Some(sink.sums)
                })
                .collect();
            let range_of = |sum: &Sum| sum.member / RANGE as u32;
            let spanned: Vec<_> =
                sums.iter().flatten().map(|sum| (*sum, (range_of(sum), range_of(sum)))).collect();
            Buckets::new(visible.len().div_ceil(RANGE), &spanned)
        })
        .collect()
}

/// Adds up the sums of all tiles; returns those above zero, ordered by (Gaussian, region).
pub fn merge(visible: &[ScreenGaussian], rows: &[Buckets<Sum>]) -> Vec<RegionWeight> {
    let parts: Vec<Vec<RegionWeight>> = visible
        .par_chunks(RANGE)
        .enumerate()
        .map(|(range, visible)| {
            let sums: Vec<&[Sum]> = rows.iter().map(|row| row.of(range)).collect();
            merge_range(visible, range * RANGE, &sums)
        })
        .collect();
    concat(&parts)
}

/// Adds up the sums of the visible Gaussians from `first` on.
fn merge_range(visible: &[ScreenGaussian], first: usize, sums: &[&[Sum]]) -> Vec<RegionWeight> {
    // A counting pass brings each Gaussian's few sums together; only those need sorting.
    let mut ends = vec![0_usize; visible.len()];
    for sum in sums.iter().copied().flatten() {
        ends[sum.member as usize - first] += 1;
    }
    let mut n_sums = 0;
    for end in &mut ends {
        n_sums += *end;
        *end = n_sums - *end;
    }
    let mut by_member = vec![(0_u32, 0_u64); n_sums];
    for sum in sums.iter().copied().flatten() {
        let end = &mut ends[sum.member as usize - first];
        by_member[*end] = (sum.region, sum.fixed);
        *end += 1;
    }
    let mut entries = Vec::with_capacity(n_sums);
    let mut start = 0;
    for (on_screen, &end) in visible.iter().zip(&ends) {
        let of_gaussian = &mut by_member[start..end];
        of_gaussian.sort_unstable_by_key(|&(region, _)| region);
        for same in of_gaussian.chunk_by(|a, b| a.0 == b.0) {
            let fixed: u64 = same.iter().map(|&(_, fixed)| fixed).sum();
            if fixed > 0 {
                let weight = (fixed as f64 / SUM_STEPS) as f32;
                entries.push(RegionWeight { gaussian: on_screen.gaussian, region: same[0].0, weight });
            }
        }
        start = end;
    }
    entries
}

/// The pixels of a region in a row of a tile.
struct Part {
    /// Index into the regions of the tile.
    slot: usize,
    /// All bits set where a pixel belongs to it.
    mask: [u32; TILE_SIZE_PX],
}

/// Adds weights up per region of a tile.
struct RegionSink {
    /// Regions of the tile.
    regions: Vec<u32>,
    /// The regions of row `y` are `parts[first_part[y]..first_part[y + 1]]`.
    parts: Vec<Part>,
    first_part: [usize; TILE_SIZE_PX + 1],
    /// Sums of the current Gaussian, per slot and column.
    weights: Vec<[f64; TILE_SIZE_PX]>,
    /// Slots that the current Gaussian has met, a bit each.
    touched: [u64; TILE_SIZE_PX * TILE_SIZE_PX / 64],
    sums: Vec<Sum>,
}

impl RegionSink {
    /// Relabels the regions of a tile; `None` if no pixel has one.
    fn new(map: &RegionMap, rect: TileRect) -> Option<Self> {
        let row_of = |y: usize| {
            let start = (rect.y_px + y) * map.width_px as usize + rect.x_px;
            &map.region_of_pixel[start..start + rect.width_px]
        };
        let mut regions: Vec<u32> = (0..rect.height_px).flat_map(row_of).copied().collect();
        regions.sort_unstable();
        regions.dedup();
        // Greater than any region.
        regions.pop_if(|last| *last == NO_REGION);
        if regions.is_empty() {
            return None;
        }
        let mut parts: Vec<Part> = Vec::new();
        let mut first_part = [0; TILE_SIZE_PX + 1];
        for y in 0..rect.height_px {
            for (x, region) in row_of(y).iter().enumerate() {
                let Ok(slot) = regions.binary_search(region) else { continue };
                let known = parts[first_part[y]..].iter().position(|part| part.slot == slot);
                let at = known.map_or(parts.len(), |at| first_part[y] + at);
                if known.is_none() {
                    parts.push(Part { slot, mask: [0; TILE_SIZE_PX] });
                }
                parts[at].mask[x] = u32::MAX;
            }
            first_part[y + 1..].fill(parts.len());
        }
        let weights = vec![[0.0; TILE_SIZE_PX]; regions.len()];
        Some(Self { regions, parts, first_part, weights, touched: Default::default(), sums: Vec::new() })
    }
}

impl WeightSink for RegionSink {
    #[inline(always)]
    fn add<S: Lanes>(&mut self, simd: S, _: u32, y: usize, v: usize, weights: S::f32s) {
        let bits: S::u32s = cast(weights);
        for part in &self.parts[self.first_part[y]..self.first_part[y + 1]] {
            let mask = cast_slice::<u32, S::u32s>(&part.mask)[v];
            let sums = &mut self.weights[part.slot][v * S::F32_LANES..][..S::F32_LANES];
            simd.add_to_f64(cast(simd.and_u32s(bits, mask)), sums);
            self.touched[part.slot / 64] |= 1 << (part.slot % 64);
        }
    }

    #[inline(always)]
    fn end<S: Lanes>(&mut self, simd: S, member: u32) {
        for word in 0..self.touched.len() {
            let mut touched = std::mem::take(&mut self.touched[word]);
            while touched != 0 {
                let slot = word * 64 + touched.trailing_zeros() as usize;
                touched &= touched - 1;
                let columns = cast_slice_mut::<f64, S::f64s>(&mut self.weights[slot]);
                let mut sum = simd.splat_f64s(0.0);
                for column in columns {
                    sum = simd.add_f64s(sum, *column);
                    *column = simd.splat_f64s(0.0);
                }
                let weight = simd.reduce_sum_f64s(sum);
                if weight > 0.0 {
                    // Rounds: the sum and the half have less than 53 bits together.
                    let fixed = (weight * SUM_STEPS + 0.5) as u64;
                    self.sums.push(Sum { member, region: self.regions[slot], fixed });
                }
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
    use super::super::draw::draw;
    use super::*;

    const WIDTH_PX: u32 = 33;
    const HEIGHT_PX: u32 = 18;

    fn scene(n: u32) -> (Vec<ScreenGaussian>, Tiles) {
        let camera = Intrinsics {
            width_px: WIDTH_PX,
            height_px: HEIGHT_PX,
            focal_x_px: 1.0,
            focal_y_px: 1.0,
            centre_x_px: 0.0,
            centre_y_px: 0.0,
            distortion: Distortion::None,
        };
        let visible: Vec<ScreenGaussian> = (0..n)
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
        (visible, tiles)
    }

    fn map(n_regions: u32, region: impl Fn(u32) -> u32) -> RegionMap {
        let region_of_pixel = (0..WIDTH_PX * HEIGHT_PX).map(region).collect();
        RegionMap { width_px: WIDTH_PX, height_px: HEIGHT_PX, region_of_pixel, n_regions }
    }

    /// Sums of whole pixels must differ by no more than the rounding of each part to 2^-32, or masks,
    /// which are unions of regions, would depend on how other masks cut them.
    #[test]
    fn fixed_point_sums_add_up_within_their_last_bit() {
        let (visible, tiles) = scene(200);
        let sums_of = |regions: RegionMap| {
            let mut sums = BTreeMap::<u32, (u64, u64)>::new();
            let rows = tile_sums(&visible, &tiles, &regions, WeightKind::Blend, Level::widest());
            for sum in rows.iter().flat_map(Buckets::iter).flatten() {
                let (fixed, n_parts) = sums.entry(sum.member).or_default();
                *fixed += sum.fixed;
                *n_parts += 1;
            }
            sums
        };
        let whole = sums_of(map(1, |_| 0));
        let parts = sums_of(map(5, |pixel| pixel % 5));
        assert!(parts.values().any(|sum| sum.1 > 20) && whole.len() == parts.len());
        for (whole, parts) in whole.values().zip(parts.values()) {
            assert!(whole.0.abs_diff(parts.0) <= whole.1 + parts.1, "{whole:?} {parts:?}");
        }
    }

    /// Every instruction set that this processor has, with regions of all shapes: none, one, stripes,
    /// a region a pixel.
    #[test]
    fn all_levels_give_the_same_bits() {
        // More than a range of `merge`.
        let (visible, tiles) = scene(RANGE as u32 + 100);
        let maps = [
            map(1, |_| 0),
            map(3, |pixel| if pixel % 11 == 0 { NO_REGION } else { pixel / 7 % 3 }),
            map(WIDTH_PX * HEIGHT_PX, |pixel| pixel),
        ];
        let colours: Vec<[f32; 3]> =
            visible.iter().map(|g| [0.1, 0.5, 0.01 * (g.gaussian % 99) as f32]).collect();
        let on_level = |level: Level| {
            let of_maps = maps.each_ref().map(|map| {
                [WeightKind::Blend, WeightKind::Falloff]
                    .map(|kind| merge(&visible, &tile_sums(&visible, &tiles, map, kind, level)))
            });
            (of_maps, draw(level, &visible, &colours, &tiles, [0.2; 3]))
        };
        let portable = on_level(Level::Portable);
        assert!(portable.0[2][0].len() > 10_000);
        assert!(portable.0[0][1].iter().any(|entry| entry.gaussian as usize > RANGE));
        for level in Level::available() {
            assert!(on_level(level) == portable, "{}", level.name());
        }
    }
}
