//! `GET /v1/floor`.

use std::borrow::Cow;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::FRAME;

/// Most cells that a client accepts: 100 m in voxels of 5 cm, each way.
const MAX_CELLS: usize = 4 << 20;

/// State of a cell for a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// No ground was seen there.
    Unknown,
    Obstacle,
    /// Ground that the robot's middle may not or cannot reach.
    Ground,
    Reached,
}

impl Place {
    const ALL: [(Self, char); 4] =
        [(Self::Unknown, 'u'), (Self::Obstacle, 'o'), (Self::Ground, 'g'), (Self::Reached, 'r')];
}

/// The ground around the robot, in square cells.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct Floor {
    /// Generation that answers.
    pub generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: Cow<'static, str>,
    /// Edge of a cell.
    pub cell_m: f64,
    /// Corner of the first cell.
    #[schemars(with = "[f64; 3]")]
    pub origin_in_world: DVec3,
    /// Cells along x and y.
    pub size: [usize; 2],
    /// A letter and a count for each run of equal cells, x first: u unknown, o obstacle, g ground, r ground that
    /// the robot reaches.
    pub runs: String,
}

pub fn runs_of(cells: &[Place]) -> String {
    let letter = |cell: Place| Place::ALL.into_iter().find(|(of, _)| *of == cell).map(|(_, letter)| letter);
    let run = |run: &[Place]| format!("{}{}", letter(run[0]).unwrap_or_default(), run.len());
    cells.chunk_by(|a, b| a == b).map(run).collect()
}

impl Floor {
    /// Returns the cells, `[size.y][size.x]`; `None` if the runs do not have that many cells, or too many.
    pub fn cells(&self) -> Option<Vec<Place>> {
        let n = self.size[0].checked_mul(self.size[1]).filter(|n| *n <= MAX_CELLS)?;
        let mut cells = Vec::with_capacity(n);
        let mut rest = self.runs.as_str();
        while let Some(letter) = rest.chars().next() {
            let (place, _) = Place::ALL.into_iter().find(|(_, of)| *of == letter)?;
            let end = rest[1..].find(|c: char| !c.is_ascii_digit()).map_or(rest.len(), |end| end + 1);
            let count: usize = rest[1..end].parse().ok()?;
            if count > n - cells.len() {
                return None;
            }
            cells.resize(cells.len() + count, place);
            rest = &rest[end..];
        }
        (cells.len() == n).then_some(cells)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_cells() {
        use Place::*;

        let floor = |runs: &str| {
            let (generation, frame, origin_in_world) = (1, FRAME.into(), DVec3::ZERO);
            Floor { generation, frame, cell_m: 0.1, origin_in_world, size: [3, 2], runs: runs.into() }.cells()
        };
        let cells = [Unknown, Obstacle, Ground, Ground, Reached, Reached];
        assert_eq!(runs_of(&cells), "u1o1g2r2");
        assert_eq!(floor("u1o1g2r2"), Some(cells.to_vec()));
        for wrong in ["", "u5", "u7", "u99999999999999999999999", "x6", "u", "u3é3", "6"] {
            assert_eq!(floor(wrong), None, "{wrong}");
        }
    }
}
