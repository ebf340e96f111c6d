//! The reference backend, on the CPU.

use bytemuck::{Zeroable, cast, cast_slice, cast_slice_mut};
use rayon::prelude::*;
use slag_common::{Gaussians, Intrinsics};
use slag_math::simd::InstructionSet;
use slag_raster::constants::{MIN_ALPHA, MIN_TRANSMITTANCE, SUM_FRACTION_BITS, TILE_SIZE_PX};
use slag_raster::{
    Buckets, Drawing, Lanes, PreparedScene, RasterView, ScreenGaussian, TileRect, Tiles, ViewCounters,
    WeightSink, bin, check_scene, check_view, concat, walk_tile,
};

use super::{LoadedScene, RasterError, Rasterizer, RegionWeight, ViewWeights};
use crate::masks::{NO_REGION, RegionMap};
use crate::memory::{MemoryPlan, Phase};

/// What a loaded scene keeps besides its Gaussians.
pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize) {
    let bytes = n_gaussians * PreparedScene::BYTES_PER_GAUSSIAN;
    memory.reserve(Phase::Views, "the size of each Gaussian", bytes as u64);
}

/// Reference backend on the current rayon pool, with the widest available instruction set.
#[derive(Clone, Copy, Debug, Default)]
pub struct CpuRasterizer;

impl Rasterizer for CpuRasterizer {
    fn identity(&self) -> String {
        "cpu".into()
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(CpuScene { prepared: PreparedScene::new(scene), instructions: InstructionSet::widest() }))
    }
}

struct CpuScene<'s> {
    prepared: PreparedScene<'s>,
    instructions: InstructionSet,
}

impl LoadedScene for CpuScene<'_> {
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        let projection = self.prepared.project(view);
        let visible = &projection.visible;
        let tiles = bin(visible, &view.intrinsics);
        let by_tile = tile_contributions(visible, &tiles, regions, self.instructions);
        let entries = merge(visible, &by_tile);
        Ok(ViewWeights { entries, counters: ViewCounters::of(&projection, &tiles) })
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        check_view(view)?;
        Ok(self.prepared.draw(self.instructions, view, background))
    }
}

/// The region map must have the view's size, and no region number out of range.
pub(super) fn check_regions(regions: &RegionMap, intrinsics: &Intrinsics) -> Result<(), RasterError> {
    let expected_px = [intrinsics.width_px, intrinsics.height_px];
    let found_px = [regions.width_px, regions.height_px];
    let found_values = regions.region_of_pixel.len();
    if found_px != expected_px || found_values as u64 != u64::from(found_px[0]) * u64::from(found_px[1]) {
        return Err(RasterError::RegionMapSize { expected_px, found_px, found_values });
    }
    let n_regions = regions.n_regions;
    match regions.region_of_pixel.iter().position(|&r| r >= n_regions && r != NO_REGION) {
        Some(pixel) => Err(RasterError::Region { pixel, found: regions.region_of_pixel[pixel], n_regions }),
        None => Ok(()),
    }
}

/// Fixed-point units per pixel of weight.
const FIXED_UNITS: f64 = (1_u64 << SUM_FRACTION_BITS) as f64;

/// Sums of a tile's weights in `f64` are exact in any order: a weight is at least 2^-22, hence a multiple of 2^-45, and
/// the sum of 256 weights fits 53 bits.
const _: () = {
    assert!(MIN_ALPHA as f64 * MIN_TRANSMITTANCE as f64 > 1.0 / (1 << 22) as f64);
    assert!(TILE_SIZE_PX * TILE_SIZE_PX <= 1 << 8);
};

#[derive(Clone, Copy, Zeroable)]
pub(crate) struct TileContribution {
    /// Index into the visible Gaussians.
    member: u32,
    region: u32,
    /// In units of `2^-SUM_FRACTION_BITS`, so that addition is exact in any order.
    fixed: u64,
}

/// Visible Gaussians per task of [`merge`]; their counts fit the cache.
const RANGE: usize = 1 << 13;

/// Contributions within each tile: for each row of tiles, one bucket per range of Gaussians.
pub(crate) fn tile_contributions(
    visible: &[ScreenGaussian],
    tiles: &Tiles,
    regions: &RegionMap,
    instructions: InstructionSet,
) -> Vec<Buckets<TileContribution>> {
    let (width_px, height_px) = (tiles.width_px as usize, tiles.height_px as usize);
    tiles
        .rows
        .par_iter()
        .enumerate()
        .map(|(row, tile_row)| {
            let members: Vec<&[u32]> = tile_row.iter().collect();
            let by_tile: Vec<Vec<TileContribution>> = members
                .into_par_iter()
                .enumerate()
                .filter_map(|(column, members)| {
                    let rect = TileRect::new(column, row, width_px, height_px);
                    let mut sink = RegionSink::new(regions, rect)?;
                    walk_tile(instructions, visible, members, rect, &mut sink);
                    Some(sink.contributions)
                })
                .collect();
            let range_of = |of_tile: &TileContribution| of_tile.member / RANGE as u32;
            let spanned: Vec<_> = (by_tile.iter().flatten())
                .map(|of_tile| (*of_tile, (range_of(of_tile), range_of(of_tile))))
                .collect();
            Buckets::new(visible.len().div_ceil(RANGE), &spanned)
        })
        .collect()
}

/// Sums contributions over all tiles; returns positive ones by (Gaussian, region).
pub(crate) fn merge(visible: &[ScreenGaussian], rows: &[Buckets<TileContribution>]) -> Vec<RegionWeight> {
    let parts: Vec<Vec<RegionWeight>> = visible
        .par_chunks(RANGE)
        .enumerate()
        .map(|(range, visible)| {
            let by_row: Vec<&[TileContribution]> = rows.iter().map(|row| row.of(range)).collect();
            merge_range(visible, range * RANGE, &by_row)
        })
        .collect();
    concat(&parts)
}

/// For the visible Gaussians from `first` on.
fn merge_range(
    visible: &[ScreenGaussian],
    first: usize,
    by_row: &[&[TileContribution]],
) -> Vec<RegionWeight> {
    // A counting sort groups each Gaussian's few contributions; only within a group they are sorted by region.
    let mut ends = vec![0_usize; visible.len()];
    for of_tile in by_row.iter().copied().flatten() {
        ends[of_tile.member as usize - first] += 1;
    }
    let mut n_contributions = 0;
    for end in &mut ends {
        n_contributions += *end;
        *end = n_contributions - *end;
    }
    let mut by_member = vec![(0_u32, 0_u64); n_contributions];
    for of_tile in by_row.iter().copied().flatten() {
        let end = &mut ends[of_tile.member as usize - first];
        by_member[*end] = (of_tile.region, of_tile.fixed);
        *end += 1;
    }
    let mut entries = Vec::with_capacity(n_contributions);
    let mut start = 0;
    for (on_screen, &end) in visible.iter().zip(&ends) {
        let of_gaussian = &mut by_member[start..end];
        of_gaussian.sort_unstable_by_key(|&(region, _)| region);
        for same in of_gaussian.chunk_by(|a, b| a.0 == b.0) {
            let fixed: u64 = same.iter().map(|&(_, fixed)| fixed).sum();
            if fixed > 0 {
                let weight = (fixed as f64 / FIXED_UNITS) as f32;
                entries.push(RegionWeight { gaussian: on_screen.gaussian, region: same[0].0, weight });
            }
        }
        start = end;
    }
    entries
}

struct Part {
    /// Index into the tile's regions.
    slot: usize,
    /// All bits set at the region's pixels.
    mask: [u32; TILE_SIZE_PX],
}

struct RegionSink {
    regions: Vec<u32>,
    /// Row `y` has the parts `first_part[y]..first_part[y + 1]`.
    parts: Vec<Part>,
    first_part: [usize; TILE_SIZE_PX + 1],
    /// Of the current Gaussian, per slot and column.
    weights: Vec<[f64; TILE_SIZE_PX]>,
    /// Slots touched by the current Gaussian, one bit each.
    touched: [u64; TILE_SIZE_PX * TILE_SIZE_PX / 64],
    contributions: Vec<TileContribution>,
}

impl RegionSink {
    /// `None` if no pixel of the tile has a region.
    fn new(map: &RegionMap, rect: TileRect) -> Option<Self> {
        let row_of = |y: usize| {
            let start = (rect.y_px + y) * map.width_px as usize + rect.x_px;
            &map.region_of_pixel[start..start + rect.width_px]
        };
        let mut regions: Vec<u32> = (0..rect.height_px).flat_map(row_of).copied().collect();
        regions.sort_unstable();
        regions.dedup();
        // `NO_REGION` is greater than any region.
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
        Some(Self {
            regions,
            parts,
            first_part,
            weights,
            touched: Default::default(),
            contributions: Vec::new(),
        })
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
                    // Rounds: weight and half together need fewer than 53 bits.
                    let fixed = (weight * FIXED_UNITS + 0.5) as u64;
                    let region = self.regions[slot];
                    self.contributions.push(TileContribution { member, region, fixed });
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::DVec2;
    use slag_common::pinhole;
    use slag_raster::{bin, draw};

    use super::*;

    const WIDTH_PX: u32 = 33;
    const HEIGHT_PX: u32 = 18;

    fn scene(n: u32, opacity: f32) -> (Vec<ScreenGaussian>, Tiles) {
        let camera = pinhole([WIDTH_PX, HEIGHT_PX], 1.0);
        let visible: Vec<ScreenGaussian> = (0..n)
            .map(|i| ScreenGaussian {
                gaussian: i,
                depth: 1.0 + i as f32,
                opacity,
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

    /// A region's contribution and the sum over its parts differ only by each part's rounding to 2^-32. Otherwise a
    /// mask, a union of regions, would depend on the masks that divide it.
    #[test]
    fn contributions_add_up_within_their_last_bit() {
        let (visible, tiles) = scene(200, 0.3);
        let contributions_of = |regions: RegionMap| {
            let mut sums = BTreeMap::<u32, (u64, u64)>::new();
            let rows = tile_contributions(&visible, &tiles, &regions, InstructionSet::widest());
            for of_tile in rows.iter().flat_map(Buckets::iter).flatten() {
                let (fixed, n_parts) = sums.entry(of_tile.member).or_default();
                *fixed += of_tile.fixed;
                *n_parts += 1;
            }
            sums
        };
        let whole = contributions_of(map(1, |_| 0));
        let parts = contributions_of(map(5, |pixel| pixel % 5));
        assert!(parts.values().any(|sum| sum.1 > 20) && whole.len() == parts.len());
        for (whole, parts) in whole.values().zip(parts.values()) {
            assert!(whole.0.abs_diff(parts.0) <= whole.1 + parts.1, "{whole:?} {parts:?}");
        }
    }

    /// All instruction sets of this processor on one region, stripes with gaps, and a region per pixel.
    #[test]
    fn all_instruction_sets_give_the_same_bits() {
        // Opaque ones, and transparent ones that exceed a range of `merge`.
        let scenes = [scene(500, 0.3), scene(RANGE as u32 + 100, 0.01)];
        let maps = [
            map(1, |_| 0),
            map(3, |pixel| if pixel % 11 == 0 { NO_REGION } else { pixel / 7 % 3 }),
            map(WIDTH_PX * HEIGHT_PX, |pixel| pixel),
        ];
        let colours: Vec<[f32; 3]> =
            (0..=RANGE + 100).map(|gaussian| [0.1, 0.5, 0.01 * (gaussian % 99) as f32]).collect();
        let on = |instructions: InstructionSet| {
            scenes.each_ref().map(|(visible, tiles)| {
                let of_map = |map| merge(visible, &tile_contributions(visible, tiles, map, instructions));
                let colours = &colours[..visible.len()];
                (maps.each_ref().map(of_map), draw(instructions, visible, colours, tiles, [0.2; 3]))
            })
        };
        let portable = on(InstructionSet::Portable);
        let [_, (of_maps, _)] = &portable;
        assert!(of_maps[2].len() > 10_000);
        assert!(of_maps[0].iter().any(|entry| entry.gaussian as usize > RANGE));
        for set in InstructionSet::available() {
            assert!(on(*set) == portable, "{}", set.name());
        }
    }
}
