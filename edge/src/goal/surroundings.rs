//! The places around a robot: ground, obstacles, clearance and paths.

use glam::DVec3;
use slag_common::occupancy::Occupancy;

use super::clearance::{self, Clearance};
use super::ground::{Floor, Ground, SURFACE_DEPTH};
use super::paths::Paths;
use super::request::{GoalRequest, LEAST_STEP_VOXELS};
use super::space::{Space, Window};
use crate::query::{QueryError, RequestError};
use crate::score::Budget;
use crate::store::Snapshot;

/// Farthest start of the path from the robot if its own place is not known to be free, metres.
pub const START_M: f64 = 0.5;
/// Most cells of a map: 50 m around the robot in voxels of 5 cm, and some 100 MB.
const MAX_CELLS: f64 = 4.2e6;

/// Most height of the request's position (its sensor's, say) above the robot's ground, metres.
const MAX_HEIGHT_M: f64 = 1.5;
/// Bytes per cell, over all steps.
const CELL_BYTES: usize = 36;

pub(super) fn no_places(kind: &'static str, detail: &str) -> QueryError {
    QueryError::Unable { kind, title: "No places known", detail: detail.to_owned() }
}

/// The ground and the obstacles.
pub(super) struct Surroundings<'a> {
    pub(super) space: Space,
    pub(super) ground: Ground,
    /// By cell: whether its ground continues the surface that the robot stands on.
    is_continued: Vec<bool>,
    pub(super) clearance: Clearance,
    pub(super) is_safe: Vec<bool>,
    step: u8,
    pub(super) budget: &'a Budget,
}

/// Returns the surface that the robot stands on: in its own column, or the nearest one up to [`START_M`] away. A
/// position in the request excludes surfaces above it (table tops) and the floor of the storey below.
fn own_surface(window: &Window, ground: &Ground, request: &GoalRequest, near: DVec3) -> Option<(usize, u8)> {
    let height = |offset: f64| window.voxel_of(near + DVec3::Z * offset)[2];
    let highest = height(request.robot.step_m(window.voxel) + SURFACE_DEPTH * window.voxel) - 1;
    let lowest = height(-MAX_HEIGHT_M) - 1;
    let surface = |cell: usize| match (request.near, ground.floors[cell]) {
        (Some(_), _) => ground.surface_below(cell, highest).filter(|z| i32::from(*z) >= lowest),
        (None, Floor::At(z)) => Some(z),
        (None, _) => None,
    };
    let found = cells_within(window, near, START_M)
        .filter_map(|(cell, distance)| Some((cell, distance, surface(cell)?)));
    let nearest = found.min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    nearest.map(|(cell, _, z)| (cell, z))
}

/// Returns the cells with their middle about this near to a point, seen from above, and their distances.
fn cells_within(window: &Window, near: DVec3, reach: f64) -> impl Iterator<Item = (usize, f64)> {
    let n = (reach / window.voxel).ceil() as i32;
    let around =
        (-n..=n).flat_map(move |x| (-n..=n).map(move |y| DVec3::new(f64::from(x), f64::from(y), 0.0)));
    let cells = around.filter_map(move |offset| window.cell_of(near + offset * window.voxel));
    let with_distance = cells.map(move |cell| {
        let [x, y] = window.centre_of(cell);
        (cell, (x - near.x).hypot(y - near.y))
    });
    with_distance.filter(move |(_, distance)| *distance <= reach + window.voxel)
}

impl<'a> Surroundings<'a> {
    /// Examines the places around a robot, which is at the request's `near`, or else at `centre`.
    ///
    /// # Errors
    /// No occupancy; a range with too many places; a step that the voxels do not tell from none;
    /// the budget.
    pub(super) fn look(
        snapshot: &Snapshot,
        request: &GoalRequest,
        centre: DVec3,
        budget: &'a Budget,
    ) -> Result<Self, QueryError> {
        let occupancies: Vec<Occupancy<'_>> =
            snapshot.shards.iter().filter_map(|shard| shard.additions().occupancy).collect();
        Self::of(&occupancies, request, centre, budget)
    }

    /// As [`Self::look`], for given occupancies.
    pub(super) fn of(
        occupancies: &[Occupancy<'_>],
        request: &GoalRequest,
        centre: DVec3,
        budget: &'a Budget,
    ) -> Result<Self, QueryError> {
        let Some(first) = occupancies.first() else {
            let detail = "the scene does not say which places are free; encode it with --occupancy, publish it, and fetch it again";
            return Err(no_places("no-occupancy", detail));
        };
        let voxel = first.header.voxel;
        let near = request.near.unwrap_or(centre);
        let most_m = MAX_CELLS.sqrt() / 2.0 * voxel;
        let too_far = |most: String| RequestError::new("range_m", &request.robot.range_m.to_string(), most);
        if request.robot.range_m > most_m {
            return Err(
                too_far(format!("at most {most_m:.1}, as the scene's voxels are {voxel} m wide")).into()
            );
        }
        let (step_m, least_m) = (request.robot.step_m(voxel), LEAST_STEP_VOXELS * voxel);
        if step_m < least_m - 1e-9 {
            let expected = format!(
                "at least {least_m:.3}, as the scene's voxels are {voxel} m high and smaller steps do not show in them"
            );
            return Err(RequestError::new("step_m", &step_m.to_string(), expected).into());
        }
        let step = (step_m / voxel - 0.5).floor().clamp(1.0, 100.0) as u8;
        let window = Window::around(near, request.robot.range_m, voxel);
        budget.take(window.cells().iter().product::<usize>() * CELL_BYTES);
        budget.check()?;
        let gathered = Space::gather(window, occupancies, budget);
        budget.check()?;
        let space = gathered
            .ok_or_else(|| too_far("a smaller range: there are more than 8 million blocks".into()))?;
        // A column has 128 voxels, so no higher robot has headroom.
        let headroom = (request.robot.height() / voxel).ceil().clamp(1.0, 128.0) as u32;
        let mut ground = Ground::find(&space, headroom, u32::from(step));
        let is_continued = match own_surface(&space.window, &ground, request, near) {
            Some((cell, z)) => ground.continue_from(cell, z, step, headroom),
            None => vec![false; ground.floors.len()],
        };
        ground.block_slopes(request.robot.slope, step, voxel);
        budget.check()?;
        let obstacles = clearance::obstacles(&ground, step);
        let clearance = Clearance::new(&obstacles, ground.n_y);
        let least = (request.robot.radius_m / voxel).powi(2).ceil() as u32;
        let is_safe = clearance.at_least(least.max(1));
        budget.check()?;
        Ok(Self { space, ground, is_continued, clearance, is_safe, step, budget })
    }

    /// Finds the paths from a safe cell.
    pub(super) fn paths_from(&self, start: usize) -> Paths {
        Paths::from(start, &self.is_safe, &self.ground, self.step)
    }

    /// Returns the distance of a cell's middle to what the robot must not touch, metres.
    pub(super) fn clearance_m(&self, cell: usize) -> f64 {
        f64::from(self.clearance.squared(cell)).sqrt() * self.space.window.voxel
    }

    pub(super) fn floor_height(&self, cell: usize) -> Option<f64> {
        let Floor::At(z) = self.ground.floors[cell] else { return None };
        let window = &self.space.window;
        Some(window.height_of(i32::from(z) + 1) - SURFACE_DEPTH * window.voxel)
    }

    /// Returns the safe cell nearest to the robot on its own ground, at most [`START_M`] or its radius away.
    pub(super) fn start(&self, near: DVec3, radius_m: f64) -> Option<usize> {
        let cells = cells_within(&self.space.window, near, START_M.max(radius_m));
        let nearest = cells
            .filter(|(cell, _)| self.is_safe[*cell] && self.is_continued[*cell])
            .min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        nearest.map(|(cell, _)| cell)
    }
}
