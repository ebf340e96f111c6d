//! A splat: positions and appearance of Gaussians in full precision.

use glam::{DVec3, Vec3};
use slag_common::Gaussians;
use slag_common::appearance::AppearanceColumns;
use slag_view::{Cell, CellState, Description, Step, cell_message};

use super::error::ViewError;
use crate::cells::{self, CellLimits, CellSplit};

pub(super) const PROGRAM: &str = "slag-encoder";
/// Gaussians per cell of a splat shown alone: small enough for a first picture within a second.
const MAX_GAUSSIANS: usize = 65_536;

/// A splat, cut into its own cells if there is no store.
pub(crate) struct Splat {
    name: String,
    pub(super) scene: Gaussians,
    split: CellSplit,
}

impl Splat {
    /// `is_alone`: there is no store whose cells count.
    pub(crate) fn new(name: String, scene: Gaussians, is_alone: bool) -> Self {
        let limits = CellLimits::by_count(MAX_GAUSSIANS);
        let split = match is_alone {
            true => cells::split(&scene, limits),
            false => CellSplit::default(),
        };
        Self { name, scene, split }
    }

    pub(super) fn describe(&self) -> Description {
        let cells = self.split.cells.iter().zip(0..).map(|(cell, id)| Cell {
            cell: id,
            n_gaussians: cell.gaussians.len() as u32,
            state: CellState::OnBoard,
            generation: 0,
            // Not of the extents: a few huge Gaussians of the sky would fill the picture.
            box_m: cell.mean_bounds.into(),
        });
        Description {
            program: PROGRAM,
            scene: self.name.clone(),
            generation: 0,
            n_gaussians: self.split.cells.iter().map(|cell| cell.gaussians.len() as u64).sum(),
            up: Vec3::Z,
            metric: false,
            geographic: false,
            can_ask: false,
            cells: cells.collect(),
            views: Vec::new(),
            fetched: None,
            position_m: None,
        }
    }

    pub(super) fn cell(&self, cell_id: u32, step: Step) -> Result<Vec<u8>, ViewError> {
        let cell = self.split.cells.get(cell_id as usize).ok_or(ViewError::NoCell { cell_id })?;
        Ok(self.message(&cell.gaussians, step))
    }

    /// Message of a cell with these Gaussians.
    ///
    /// # Panics
    /// If an index is not one of the splat.
    pub(super) fn message(&self, indices: &[u32], step: Step) -> Vec<u8> {
        let positions: Vec<DVec3> =
            step.of(indices).map(|index| self.scene.means_in_world[*index as usize]).collect();
        cell_message(&positions, Some(AppearanceColumns::of(&self.scene, indices).view()), step)
    }
}
