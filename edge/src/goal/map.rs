//! The ground around a robot as a picture, for people and for other planners.

use std::io::{self, Write};

use glam::DVec3;
use slag_api::floor::Place;

use super::ground::Floor;
use super::request::GoalRequest;
use super::surroundings::Surroundings;
use crate::query::QueryError;
use crate::score::Budget;
use crate::store::Snapshot;

#[derive(Clone, Debug, PartialEq)]
pub struct FloorMap {
    pub cell_m: f64,
    /// Least x and y of the first cell.
    pub origin_in_world: DVec3,
    pub size: [usize; 2],
    /// `[size.y][size.x]`, x first as in ROS.
    pub places: Vec<Place>,
}

/// Maps the ground around a robot; the request's thing is ignored.
pub fn floor_map(
    snapshot: &Snapshot,
    request: &GoalRequest,
    budget: &Budget,
) -> Result<FloorMap, QueryError> {
    request.check()?;
    let near = request.near.unwrap_or(snapshot.current.centre_in_world);
    let seen = Surroundings::look(snapshot, request, near, budget)?;
    let start = seen.start(near, request.robot.radius_m);
    let paths = start.map(|start| seen.paths_from(start));
    budget.check()?;
    let window = &seen.space.window;
    let [n_x, n_y] = window.cells();
    let place = |x: usize, y: usize| {
        let cell = x * n_y + y;
        match seen.ground.floors[cell] {
            Floor::Unknown => Place::Unknown,
            Floor::Blocked => Place::Obstacle,
            Floor::At(_) if seen.clearance.is_obstacle(cell) => Place::Obstacle,
            Floor::At(_) if paths.as_ref().is_some_and(|paths| paths.to(cell).is_some()) => Place::Reached,
            Floor::At(_) => Place::Ground,
        }
    };
    let [x, y] = window.centre_of(0);
    Ok(FloorMap {
        cell_m: window.voxel,
        origin_in_world: DVec3::new(x - window.voxel / 2.0, y - window.voxel / 2.0, near.z),
        size: [n_x, n_y],
        places: (0..n_y).flat_map(|y| (0..n_x).map(move |x| (x, y))).map(|(x, y)| place(x, y)).collect(),
    })
}

impl FloorMap {
    /// Writes a PGM for ROS's map_server, north (y) up: unknown 128, obstacles 0, ground 200, reachable ground 255.
    pub(crate) fn write_pgm(&self, mut out: impl Write) -> io::Result<()> {
        let [width, height] = self.size;
        write!(out, "P5\n{width} {height}\n255\n")?;
        let grey = |place: &Place| match place {
            Place::Unknown => 128u8,
            Place::Obstacle => 0,
            Place::Ground => 200,
            Place::Reached => 255,
        };
        let rows = self.places.chunks_exact(width.max(1)).rev();
        rows.into_iter().try_for_each(|row| out.write_all(&row.iter().map(grey).collect::<Vec<u8>>()))
    }
}
