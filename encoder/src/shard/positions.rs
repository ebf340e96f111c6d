//! Means in as few bits as an error in world units allows.

use glam::DVec3;
use slag_common::Gaussians;
use slag_common::shard::{PositionForm, Positions};

use crate::cells::Cell;

/// A cell's positions, on the cell's grid.
pub(super) struct QuantisedPositions {
    /// Largest distance of a stored position from the mean, per axis: half a step, unless the doubles of readers
    /// are coarser.
    pub(super) error: f64,
    columns: Columns,
}

enum Columns {
    Packed(Vec<u32>),
    Wide(Vec<[u16; 3]>),
    Full(Vec<[u32; 3]>),
}

impl QuantisedPositions {
    /// Rounds the means of a cell's Gaussians, in the order of `locals`.
    pub(super) fn new(scene: &Gaussians, cell: &Cell, locals: &[u32]) -> Self {
        let (step, bits) = (cell.grid.step, cell.grid.bits);
        let largest: [f64; 3] = std::array::from_fn(|axis| ((1u64 << bits[axis]) - 1) as f64);
        let origin = cell.mean_bounds.min;
        let mut error = step.into_iter().fold(0.0, f64::max) / 2.0;
        let steps = locals.iter().map(|local| {
            let mean = scene.means_in_world[cell.gaussians[*local as usize] as usize];
            let offset: DVec3 = mean - origin;
            let steps: [u32; 3] = std::array::from_fn(|axis| match step[axis] > 0.0 {
                true => (offset[axis] / step[axis]).round().clamp(0.0, largest[axis]) as u32,
                false => 0,
            });
            let stored = origin + DVec3::from(steps.map(f64::from)) * DVec3::from(step);
            error = (stored - mean).abs().max_element().max(error);
            steps
        });
        let columns = match PositionForm::of(bits) {
            PositionForm::Wide => Columns::Wide(steps.map(|at| at.map(|v| v as u16)).collect()),
            PositionForm::Full => Columns::Full(steps.collect()),
            PositionForm::Packed => {
                let pack = |[x, y, z]: [u32; 3]| {
                    let (y, z) = (u64::from(y) << bits[0], u64::from(z) << (bits[0] + bits[1]));
                    (u64::from(x) | y | z) as u32
                };
                Columns::Packed(steps.map(pack).collect())
            }
        };
        Self { error, columns }
    }

    /// Returns the columns to write.
    pub(super) fn view(&self) -> Positions<'_> {
        match &self.columns {
            Columns::Packed(words) => Positions::Packed(words),
            Columns::Wide(steps) => Positions::Wide(steps),
            Columns::Full(steps) => Positions::Full(steps),
        }
    }
}
