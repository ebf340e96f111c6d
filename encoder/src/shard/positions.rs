//! Means in as few bits as an error in world units allows.

use glam::DVec3;
use slag_common::Gaussians;
use slag_common::shard::Positions;
use slag_math::stats::{Rank, quantile};

use crate::cells::Cell;

/// Largest error of a position, per axis.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum PositionError {
    /// World units.
    Within(f64),
    /// A quarter of the 10th percentile of the largest scales of a cell's Gaussians: the size of its small ones.
    OfSize,
}

impl PositionError {
    /// Returns one centimetre for a metric model, else the size of the Gaussians.
    pub fn default_for(metric: bool) -> Self {
        if metric { Self::Within(0.01) } else { Self::OfSize }
    }

    fn for_cell(self, scene: &Gaussians, cell: &Cell) -> f64 {
        match self {
            Self::Within(error) => error,
            Self::OfSize => {
                let mut sizes: Vec<f32> = cell
                    .gaussians
                    .iter()
                    .map(|g| scene.scales[*g as usize].into_iter().fold(0.0, f32::max))
                    .collect();
                quantile(&mut sizes, 100, Rank::After).map_or(0.0, |size| f64::from(size) / 4.0)
            }
        }
    }
}

/// Bits of an axis in the wide form.
const WIDE_BITS: u8 = 16;
/// Bits of a packed position.
const PACKED_BITS: u32 = 32;

/// A cell's positions.
pub struct QuantisedPositions {
    /// World units per step.
    pub step: [f64; 3],
    /// Bits per axis, and 0.
    pub bits: [u8; 4],
    packed: Vec<u32>,
    wide: Vec<[u16; 3]>,
}

impl QuantisedPositions {
    /// Rounds the means of a cell's Gaussians, in the order of `locals`, relative to the box of its means.
    pub fn new(scene: &Gaussians, cell: &Cell, locals: &[u32], error: PositionError) -> Self {
        let size = cell.mean_bounds.size().to_array();
        let bits = packed_bits(size, error.for_cell(scene, cell));
        let bits = bits.map_or([WIDE_BITS, WIDE_BITS, WIDE_BITS, 0], |[x, y, z]| [x, y, z, 0]);
        let largest: [f64; 3] = std::array::from_fn(|axis| ((1u64 << bits[axis]) - 1) as f64);
        // A flat axis has step 0 and every offset 0.
        let step =
            std::array::from_fn(|axis| if largest[axis] > 0.0 { size[axis] / largest[axis] } else { 0.0 });
        let steps = locals.iter().map(|local| {
            let mean = scene.means_in_world[cell.gaussians[*local as usize] as usize];
            let offset: DVec3 = mean - cell.mean_bounds.min;
            std::array::from_fn(|axis| match step[axis] > 0.0 {
                true => (offset[axis] / step[axis]).round().clamp(0.0, largest[axis]) as u32,
                false => 0,
            })
        });
        match bits[..3] == [WIDE_BITS; 3] {
            true => Self {
                step,
                bits,
                wide: steps.map(|at: [u32; 3]| at.map(|v| v as u16)).collect(),
                packed: Vec::new(),
            },
            false => {
                let pack = |[x, y, z]: [u32; 3]| {
                    let (y, z) = (u64::from(y) << bits[0], u64::from(z) << (bits[0] + bits[1]));
                    (u64::from(x) | y | z) as u32
                };
                Self { step, bits, packed: steps.map(pack).collect(), wide: Vec::new() }
            }
        }
    }

    /// Returns the columns to write.
    pub fn view(&self) -> Positions<'_> {
        match self.bits[..3] == [WIDE_BITS; 3] {
            true => Positions::Wide(&self.wide),
            false => Positions::Packed(&self.packed),
        }
    }
}

/// Returns the bits of each axis, 32 in all, that keep the error; `None` if 32 are too few.
fn packed_bits(size: [f64; 3], error: f64) -> Option<[u8; 3]> {
    let step_of = |axis: usize, bits: u8| size[axis] / ((1u64 << bits) - 1).max(1) as f64;
    let mut bits = [0u8; 3];
    loop {
        // Each bit goes to the coarsest axis.
        let axis = (0..3).max_by(|a, b| {
            let coarseness =
                |axis: usize| if bits[axis] == 0 { 2.0 * size[axis] } else { step_of(axis, bits[axis]) };
            coarseness(*a).total_cmp(&coarseness(*b))
        })?;
        if bits.iter().map(|b| u32::from(*b)).sum::<u32>() == PACKED_BITS
            || size[axis] <= 0.0
            || bits[axis] == 31
        {
            break;
        }
        bits[axis] += 1;
    }
    let keeps =
        (0..3).all(|axis| size[axis] <= 0.0 || bits[axis] > 0 && step_of(axis, bits[axis]) / 2.0 <= error);
    // These bits mark the wide form.
    (keeps && bits != [WIDE_BITS; 3]).then_some(bits)
}
