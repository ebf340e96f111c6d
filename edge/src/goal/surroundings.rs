//! The places around a robot: ground, obstacles, clearance and ways.

use glam::DVec3;
use slag_common::occupancy::Occupancy;

use super::clearance::{self, Clearance};
use super::error::GoalError;
use super::ground::{Floor, Ground, SURFACE_DEPTH};
use super::paths::Paths;
use super::request::GoalRequest;
use super::space::{Space, Window};
use crate::query::RequestError;
use crate::store::Snapshot;

/// Farthest place, metres, from which the way may begin where the robot's own place is not known to be free.
pub const START_M: f64 = 0.5;
/// Most cells of a map: 50 m around the robot in voxels of 5 cm, and some 100 MB.
const MAX_CELLS: f64 = 4.2e6;

/// What is known of the places around a robot.
pub struct Around<'a> {
    pub space: &'a Space,
    pub ground: &'a Ground,
    pub paths: Paths,
    clearance: &'a Clearance,
}

impl Around<'_> {
    /// Returns the distance of a cell to the nearest obstacle, metres.
    pub fn clearance(&self, cell: usize) -> f64 {
        f64::from(self.clearance.squared(cell)).sqrt() * self.space.window.voxel
    }

    /// Returns the height of the ground of a cell, world frame.
    pub fn floor_height(&self, cell: usize) -> Option<f64> {
        match self.ground.floors[cell] {
            Floor::At(z) => {
                let window = &self.space.window;
                Some(window.height_of(i32::from(z) + 1) - SURFACE_DEPTH * window.voxel)
            }
            _ => None,
        }
    }
}

/// The ground, and what the robot must keep clear of.
pub(super) struct Surroundings {
    pub(super) space: Space,
    pub(super) ground: Ground,
    pub(super) clearance: Clearance,
    pub(super) is_safe: Vec<bool>,
    /// Highest step, voxels.
    pub(super) step: u8,
}

impl Surroundings {
    /// Looks at the places around a robot.
    ///
    /// # Errors
    /// [`GoalError::NoOccupancy`]; a range with too many places.
    pub(super) fn look(snapshot: &Snapshot, request: &GoalRequest, near: DVec3) -> Result<Self, GoalError> {
        let occupancies: Vec<Occupancy<'_>> =
            snapshot.shards.iter().filter_map(|shard| shard.occupancy()).collect();
        Self::of(&occupancies, request, near)
    }

    /// Looks at the places of some occupancies, as [`Self::look`] does.
    pub(super) fn of(
        occupancies: &[Occupancy<'_>],
        request: &GoalRequest,
        near: DVec3,
    ) -> Result<Self, GoalError> {
        let voxel = occupancies.first().ok_or(GoalError::NoOccupancy)?.header.voxel;
        let most_m = MAX_CELLS.sqrt() / 2.0 * voxel;
        let too_far = |most: String| RequestError::new("range_m", &request.range_m.to_string(), most);
        if request.range_m > most_m {
            return Err(
                too_far(format!("at most {most_m:.1}, as the scene's voxels are {voxel} m wide")).into()
            );
        }
        let window = Window::around(near, request.range_m, voxel);
        let space = Space::gather(window, occupancies)
            .ok_or_else(|| too_far("a smaller range: there are more than 8 million blocks".into()))?;
        // A column has 128 voxels, so no higher robot has headroom.
        let headroom = (request.height() / voxel).ceil().clamp(1.0, 128.0) as u32;
        // Heights of surfaces are known to half a voxel, so a difference of n voxels may be n and a half high.
        let step = (request.step_m / voxel - 0.5).floor().clamp(1.0, 100.0) as u8;
        let ground = Ground::find(&space, headroom, u32::from(step));
        let obstacles = clearance::obstacles(&ground, step);
        let clearance = Clearance::new(&obstacles, ground.n_y);
        let least = (request.radius_m / voxel).powi(2).ceil() as u32;
        let is_safe = clearance.at_least(least.max(1));
        Ok(Self { space, ground, clearance, is_safe, step })
    }

    /// Begins the ways from a safe cell.
    pub(super) fn around(&self, start: usize) -> Around<'_> {
        let paths = Paths::from(start, &self.is_safe, &self.ground, self.step);
        Around { space: &self.space, ground: &self.ground, paths, clearance: &self.clearance }
    }

    /// Returns the safe cell nearest to the robot, at most [`START_M`] or its radius away.
    pub(super) fn start(&self, near: DVec3, radius_m: f64) -> Option<usize> {
        let window = &self.space.window;
        let distance = |cell: usize| {
            let [x, y] = window.centre_of(cell);
            (x - near.x).hypot(y - near.y)
        };
        let reach = START_M.max(radius_m);
        let n = (reach / window.voxel).ceil() as i32;
        let around =
            (-n..=n).flat_map(|x| (-n..=n).map(move |y| DVec3::new(f64::from(x), f64::from(y), 0.0)));
        let cells = around.filter_map(|offset| window.cell_of(near + offset * window.voxel));
        cells
            .filter(|cell| self.is_safe[*cell] && distance(*cell) <= reach + window.voxel)
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)).then(a.cmp(b)))
    }
}
