//! The reply to `/v1/floor`.

use serde::Deserialize;

/// Most cells that are taken: 100 m in voxels of 5 cm, each way.
const MAX_CELLS: usize = 4 << 20;

/// The ground around a robot. Members that clients here do not need are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct Floor {
    /// Edge of a cell, metres.
    pub cell_m: f64,
    /// Corner of the first cell: the least x and y.
    pub origin_in_world: [f64; 3],
    /// Cells along x and y.
    pub size: [usize; 2],
    /// Runs of equal cells, x first: a letter and a count each.
    runs: String,
}

/// What a cell is to the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// Nobody has seen ground there.
    Unknown,
    /// It must not be touched.
    Obstacle,
    /// Ground; the robot's middle may not or cannot go there.
    Ground,
    /// The robot's middle can go there.
    Reached,
}

impl Floor {
    /// Returns the cells, `[size.y][size.x]`; `None` if the runs are not as many cells, or too many.
    pub fn cells(&self) -> Option<Vec<Place>> {
        let n = self.size[0].checked_mul(self.size[1]).filter(|n| *n <= MAX_CELLS)?;
        let mut cells = Vec::with_capacity(n);
        let mut rest = self.runs.as_str();
        while let Some(letter) = rest.chars().next() {
            let place = match letter {
                'u' => Place::Unknown,
                'o' => Place::Obstacle,
                'g' => Place::Ground,
                'r' => Place::Reached,
                _ => return None,
            };
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
        let floor = |runs: &str| {
            Floor { cell_m: 0.1, origin_in_world: [0.0; 3], size: [3, 2], runs: runs.into() }.cells()
        };
        use Place::*;
        assert_eq!(floor("u1o1g2r2"), Some(vec![Unknown, Obstacle, Ground, Ground, Reached, Reached]));
        for wrong in ["", "u5", "u7", "u99999999999999999999999", "x6", "u", "u3é3", "6"] {
            assert_eq!(floor(wrong), None, "{wrong}");
        }
    }
}
