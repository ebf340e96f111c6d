//! Data that host and shaders exchange. A test compares these structures with those of the shaders.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use slag_common::Gaussians;
use slag_raster::constants::{MIN_ALPHA, TILE_SIZE_PX};
use slag_raster::{RasterView, reach2};

use super::shader::{Counter, Counts, SUM_FRACTION_BITS};
use crate::raster::{Precision, RegionWeight};

/// A Gaussian in device memory.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct SceneGaussian {
    /// Relative to the scene's origin, rounded to `f32`.
    pub(crate) mean_high: [f32; 3],
    /// 0 if the Gaussian cannot be drawn.
    pub opacity: f32,
    /// Rounding error of `mean_high`.
    pub(crate) mean_low: [f32; 3],
    /// See [`slag_raster::ScreenGaussian::reach2`].
    pub(crate) reach2: f32,
    pub(crate) rotation_wxyz: [f32; 4],
    /// Standard deviations, world units.
    pub scales: [f32; 3],
    pub padding: u32,
}

impl SceneGaussian {
    pub fn new(scene: &Gaussians, index: usize, origin_in_world: DVec3) -> Self {
        let opacity = scene.opacities[index];
        if !scene.is_usable(index) || opacity < MIN_ALPHA {
            return Self::zeroed();
        }
        let mean = scene.means_in_world[index] - origin_in_world;
        let (mean_high, mean_low) = high_and_low(mean);
        if !mean_high.iter().all(|c| c.is_finite()) {
            return Self::zeroed();
        }
        Self {
            mean_high,
            opacity,
            mean_low,
            reach2: reach2(opacity),
            rotation_wxyz: scene.rotations_wxyz[index],
            scales: scene.scales[index],
            padding: 0,
        }
    }
}

/// Splits a vector into its `f32` rounding and the error: 48 bits in total.
fn high_and_low(value: DVec3) -> ([f32; 3], [f32; 3]) {
    let high = value.as_vec3();
    (high.to_array(), (value - high.as_dvec3()).as_vec3().to_array())
}

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Chunk {
    pub(crate) first_gaussian: u32,
    pub n_gaussians: u32,
}

/// Parameters of a prefix sum; see `scan.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct ScanJob {
    pub items: u32,
    /// Upper limit of the number of items; exact without a counter.
    pub(crate) n_most: u32,
    pub block: u32,
    /// Values per block.
    pub columns: u32,
    pub total: u32,
}

/// Parameters of a pass of a radix sort; see `sort.wgsl`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct SortPass {
    pub items: u32,
    /// Words between keys.
    pub stride: u32,
    /// Word of the first key.
    pub offset: u32,
    /// Subtracted from each word at `offset`.
    pub least: u32,
    /// Lower bits of the key, which come from the word after `offset`.
    pub(crate) low_bits: u32,
    /// In bits.
    pub shift: u32,
    pub capacity: u32,
}

/// Summed over all tiles of a band, in units of `2^-SUM_FRACTION_BITS`.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct RegionSum {
    pub gaussian: u32,
    pub region: u32,
    /// Lower word.
    pub low: u32,
    /// Upper word.
    pub high: u32,
}

impl RegionSum {
    pub fn fixed(&self) -> u64 {
        u64::from(self.high) << 32 | u64::from(self.low)
    }

    pub fn weight(&self, fixed: u64) -> RegionWeight {
        let weight = (fixed as f64 / (1u64 << SUM_FRACTION_BITS) as f64) as f32;
        RegionWeight { gaussian: self.gaussian, region: self.region, weight }
    }
}

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct Background {
    pub rgb: [f32; 3],
    pub padding: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Capacities {
    pub visible: u32,
    pub pairs: u32,
    /// Per tile, Gaussian and region.
    pub entries: u32,
}

impl Capacities {
    pub(crate) fn needed(counts: &Counts) -> Self {
        let [visible, pairs, entries] =
            [Counter::Visible, Counter::Pairs, Counter::Entries].map(|counter| counts[counter as usize]);
        Self { visible, pairs, entries }
    }

    pub(crate) fn hold(&self, needed: &Self) -> bool {
        needed.visible <= self.visible && needed.pairs <= self.pairs && needed.entries <= self.entries
    }

    /// Adds a quarter to what was needed where it was too little: an overflow truncates the counts of later stages.
    pub(crate) fn grown(&self, needed: &Self, max: &Self) -> Self {
        let grown = |needed: u32, now: u32, max: u32| {
            if needed > now { needed.saturating_add(needed / 4).min(max) } else { now }
        };
        Self {
            visible: grown(needed.visible, self.visible, max.visible),
            pairs: grown(needed.pairs, self.pairs, max.pairs),
            entries: grown(needed.entries, self.entries, max.entries),
        }
    }
}

pub(crate) struct ViewBlock {
    /// `rotation` (9), `position_high` (3), `position_low` (3), focal lengths, centre.
    pub(crate) reals: [f64; 19],
    /// From `width_px` to `capacity_entries`.
    pub words: [u32; 8],
}

impl ViewBlock {
    /// A band of a view with these rows of tiles; `origin_in_world` is the means' origin on the device.
    pub fn new(
        view: &RasterView,
        origin_in_world: DVec3,
        tile_rows: [u32; 2],
        capacities: Capacities,
    ) -> Self {
        let camera = &view.intrinsics;
        let rotation = view.camera_from_world.matrix3;
        let position = view.camera_from_world.inverse().translation - origin_in_world;
        let (high, _) = high_and_low(position);
        let low = position - DVec3::from_array(high.map(f64::from));
        let mut reals = [0.0; 19];
        reals[..9].copy_from_slice(&rotation.transpose().to_cols_array());
        reals[9..12].copy_from_slice(&high.map(f64::from));
        reals[12..15].copy_from_slice(&low.to_array());
        reals[15..].copy_from_slice(&[
            camera.focal_x_px,
            camera.focal_y_px,
            camera.centre_x_px,
            camera.centre_y_px,
        ]);
        let words = [
            camera.width_px,
            camera.height_px,
            tile_rows[0],
            tile_rows[1],
            camera.width_px.div_ceil(TILE_SIZE_PX as u32),
            capacities.visible,
            capacities.pairs,
            capacities.entries,
        ];
        Self { reals, words }
    }

    pub fn to_bytes(&self, precision: Precision) -> Vec<u8> {
        let mut bytes: Vec<u8> = match precision {
            Precision::F64 => self.reals.iter().flat_map(|r| r.to_le_bytes()).collect(),
            Precision::F32 => self.reals.iter().flat_map(|r| (*r as f32).to_le_bytes()).collect(),
        };
        bytes.extend(self.words.iter().flat_map(|w| w.to_le_bytes()));
        bytes
    }
}

/// Bytes of a Gaussian on the screen, and the index of its depth word.
pub(crate) fn screen_layout(precision: Precision) -> (u32, u32) {
    match precision {
        Precision::F64 => (56, 10),
        Precision::F32 => (36, 5),
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use super::*;
    use crate::raster::gpu::shader::module_text;

    /// Members (name, offset, size) and total size of a structure in a shader.
    fn layout_of(stage: &str, name: &str, precision: Precision) -> (Vec<(String, usize, usize)>, usize) {
        let module = naga::front::wgsl::parse_str(&module_text(stage, precision)).expect("parses");
        let context = module.to_ctx();
        let (_, found) = module.types.iter().find(|(_, t)| t.name.as_deref() == Some(name)).expect(name);
        let naga::TypeInner::Struct { members, span } = &found.inner else { panic!("{name}: no structure") };
        let columns = members
            .iter()
            .map(|m| {
                let bytes = module.types[m.ty].inner.size(context) as usize;
                (m.name.clone().unwrap_or_default(), m.offset as usize, bytes)
            })
            .collect();
        (columns, *span as usize)
    }

    macro_rules! assert_layout {
        ($stage:literal, $type:ident; $($field:ident),+ $(,)?) => {{
            // Fails to compile if a field is missing.
            let _ = |value: $type| { let $type { $($field: _),+ } = value; };
            let sizes = |value: $type| [$(size_of_val(&value.$field)),+];
            let sizes = sizes($type::zeroed());
            let names = [$((stringify!($field), offset_of!($type, $field))),+];
            let expected: Vec<(String, usize, usize)> =
                names.iter().zip(sizes).map(|((n, o), s)| ((*n).to_owned(), *o, s)).collect();
            for precision in [Precision::F64, Precision::F32] {
                let (mut found, size_bytes) = layout_of($stage, stringify!($type), precision);
                found.retain(|(name, ..)| !name.starts_with("padding") || names.iter().any(|n| n.0 == name));
                assert_eq!(found, expected, "{} {precision:?}", stringify!($type));
                assert!(size_bytes >= size_of::<$type>(), "{size_bytes}");
            }
        }};
    }

    #[test]
    fn shaders_have_the_hosts_structures() {
        assert_layout!("project", SceneGaussian; mean_high, opacity, mean_low, reach2, rotation_wxyz, scales, padding);
        assert_eq!(layout_of("project", "SceneGaussian", Precision::F32).1, size_of::<SceneGaussian>());
        assert_layout!("project", Chunk; first_gaussian, n_gaussians);
        assert_layout!("scan", ScanJob; items, n_most, block, columns, total);
        assert_layout!("sort", SortPass; items, stride, offset, least, low_bits, shift, capacity);
        assert_layout!("draw", Background; rgb, padding);
        assert_layout!("compact", RegionSum; gaussian, region, low, high);
        assert_eq!(layout_of("compact", "RegionSum", Precision::F32).1, size_of::<RegionSum>());
        for precision in [Precision::F64, Precision::F32] {
            let (columns, size_bytes) = layout_of("project", "Screen", precision);
            let depth = columns.iter().find(|c| c.0 == "depth").expect("depth").1;
            assert_eq!(screen_layout(precision), (size_bytes as u32, depth as u32 / 4));

            let (columns, size_bytes) = layout_of("project", "View", precision);
            let names: Vec<&str> = columns.iter().map(|c| c.0.as_str()).collect();
            let expected = "rotation position_high position_low focal_x_px focal_y_px centre_x_px centre_y_px \
                            width_px height_px first_tile_row end_tile_row tile_columns capacity_visible \
                            capacity_pairs capacity_entries";
            assert_eq!(names.join(" "), expected);
            let real_bytes = if precision == Precision::F64 { 8 } else { 4 };
            assert!(columns.windows(2).all(|w| w[0].1 + w[0].2 == w[1].1), "no gaps: {columns:?}");
            assert_eq!(columns.iter().find(|c| c.0 == "width_px").expect("width_px").1, 19 * real_bytes);
            let block = ViewBlock { reals: [0.0; 19], words: [0; 8] };
            assert_eq!(block.to_bytes(precision).len(), size_bytes);
        }
    }
}
