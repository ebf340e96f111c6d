//! The replies to `/v1/map` and `/v1/objects`.

use serde::Deserialize;

/// What is on board. Members that clients here do not need are left out.
#[derive(Clone, Debug, Deserialize)]
pub struct Place {
    pub scene: String,
    /// The published state on board.
    pub generation: u64,
    pub frame: String,
    /// `m`, or `world` for scenes whose scale is unknown.
    pub unit: String,
    /// Whether z is known to point up.
    pub z_is_up: bool,
    /// Seconds since the state was published.
    pub age_secs: u64,
    /// Whether the store's signatures are past their expiry.
    pub is_expired: bool,
    /// Middle of what was fetched.
    pub centre_in_world: [f64; 3],
    /// All cells that this ball touches were asked for.
    pub radius: f64,
    /// Things on board.
    pub n_objects: u64,
    /// Pieces of space on board.
    pub cells: Vec<Cell>,
    /// Pieces of space that the scene has and the robot has not.
    pub missing: Vec<Cell>,
}

/// A piece of space.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Cell {
    #[serde(flatten)]
    pub bounds: Box3,
    /// Whether the robot wanted it and could not fetch it; of missing cells only.
    #[serde(default)]
    pub is_wanted: bool,
}

/// Things on board.
#[derive(Clone, Debug, Deserialize)]
pub struct OnBoard {
    pub scene: String,
    /// The published state on board.
    pub generation: u64,
    /// `m`, or `world` for scenes whose scale is unknown.
    pub unit: String,
    /// Whether the things have names.
    pub named: bool,
    /// Things that were asked for, over all pages.
    pub n_objects: u64,
    /// `after` of the next page, if there is one.
    pub next_after: Option<String>,
    /// Those of this page.
    pub objects: Vec<OnBoardThing>,
}

/// A thing on board.
#[derive(Clone, Debug, Deserialize)]
pub struct OnBoardThing {
    /// Stable within a generation.
    pub id: String,
    /// What it is called, best first.
    pub names: Vec<Name>,
    /// Its middle.
    pub position_in_world: [f64; 3],
    #[serde(flatten)]
    pub bounds: Box3,
}

/// A name of a thing.
#[derive(Clone, Debug, Deserialize)]
pub struct Name {
    pub name: String,
    /// The chance that it is right.
    pub confidence: f64,
}

/// A box along the axes.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
pub struct Box3 {
    #[serde(rename = "box_min_in_world")]
    pub min: [f64; 3],
    /// Greatest corner.
    #[serde(rename = "box_max_in_world")]
    pub max: [f64; 3],
}

impl Box3 {
    /// Returns the least box around two.
    pub fn union(self, other: Self) -> Self {
        Self {
            min: std::array::from_fn(|axis| self.min[axis].min(other.min[axis])),
            max: std::array::from_fn(|axis| self.max[axis].max(other.max[axis])),
        }
    }

    /// Returns whether a ball touches the box.
    pub fn touches(&self, centre: [f64; 3], radius: f64) -> bool {
        let squared = |axis: usize| {
            let nearest = centre[axis].max(self.min[axis]).min(self.max[axis]);
            (nearest - centre[axis]).powi(2)
        };
        (0..3).map(squared).sum::<f64>() <= radius * radius
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn balls_touch_boxes_at_their_nearest_point() {
        let unit = Box3 { min: [0.0; 3], max: [1.0; 3] };
        assert!(unit.touches([0.5; 3], 0.0) && unit.touches([2.0, 0.5, 0.5], 1.0));
        assert!(!unit.touches([2.0, 0.5, 0.5], 0.99));
        // Beyond a corner the distance counts, not each axis.
        assert!(!unit.touches([2.0, 2.0, 2.0], 1.7) && unit.touches([2.0, 2.0, 2.0], 1.74));
        let both = unit.union(Box3 { min: [-1.0, 0.5, 0.5], max: [0.0, 2.0, 0.7] });
        assert_eq!(both, Box3 { min: [-1.0, 0.0, 0.0], max: [1.0, 2.0, 1.0] });
    }
}
