//! The ground around the robot, as a map for planners.

use slag_robot::api::floor::{Floor, Place};

use crate::geometry::Pose;
use crate::messages::{Header, MapMetaData, OccupancyGrid};

/// Most cells of a map, to stay below 64 kB, the most that UDP takes at once.
const MAX_CELLS: usize = 60_000;
/// Margin of ground shown around the reached area, metres.
const MARGIN_M: f64 = 0.5;
const FREE: i8 = 0;
const OCCUPIED: i8 = 100;
const UNKNOWN: i8 = -1;

/// Returns the map, or `None` if the robot's reply is invalid or it reaches nothing.
///
/// Only ground under the robot is free: within `radius_m` of a place that its middle reaches, which is clear of
/// obstacles by that much. A table top or car roof is unreachable ground, so unknown. Cells are joined until few
/// enough; a joined one is free only if all of it is, and occupied if any of it is.
pub fn grid(header: Header, floor: &Floor, radius_m: f64) -> Option<OccupancyGrid> {
    let places = floor.cells()?;
    let [width, height] = floor.size;
    if !(floor.cell_m > 0.0 && floor.cell_m.is_finite()) {
        return None;
    }
    let is_free = free(&places, floor.size, radius_m / floor.cell_m);
    let margin = (MARGIN_M / floor.cell_m).ceil() as usize;
    let free = || (0..places.len()).filter(|cell| is_free[*cell]);
    let range = |of: &dyn Fn(usize) -> usize, n: usize| {
        let (low, high) = (free().map(of).min()?, free().map(of).max()?);
        Some((low.saturating_sub(margin), (high + margin + 1).min(n)))
    };
    let (left, right) = range(&|cell| cell % width, width)?;
    let (low, high) = range(&|cell| cell / width, height)?;
    let n_cells = |edge: usize| (right - left).div_ceil(edge) * (high - low).div_ceil(edge);
    let edge = (1..).find(|edge| n_cells(*edge) <= MAX_CELLS)?;
    let (n_x, n_y) = ((right - left).div_ceil(edge), (high - low).div_ceil(edge));
    let joined = |x: usize, y: usize| {
        let (xs, ys) = (left + x * edge..left + (x + 1) * edge, low + y * edge..low + (y + 1) * edge);
        let mut all_free = xs.end <= width && ys.end <= height;
        for cell in ys
            .filter(|y| *y < height)
            .flat_map(|y| xs.clone().filter(|x| *x < width).map(move |x| y * width + x))
        {
            if places[cell] == Place::Obstacle {
                return OCCUPIED;
            }
            all_free &= is_free[cell];
        }
        if all_free { FREE } else { UNKNOWN }
    };
    let [x, y, z] = floor.origin_in_world.to_array();
    let corner = [x + left as f64 * floor.cell_m, y + low as f64 * floor.cell_m, z];
    Some(OccupancyGrid {
        info: MapMetaData {
            map_load_time: header.stamp,
            resolution: (floor.cell_m * edge as f64) as f32,
            width: n_x as u32,
            height: n_y as u32,
            origin: Pose::at(corner),
        },
        header,
        data: (0..n_y).flat_map(|y| (0..n_x).map(move |x| (x, y))).map(|(x, y)| joined(x, y)).collect(),
    })
}

/// Returns the cells nearer than `radius` cells to a reached one; one at just `radius` may be an obstacle.
fn free(places: &[Place], [width, height]: [usize; 2], radius: f64) -> Vec<bool> {
    let reach = radius.clamp(0.0, 1e3).floor() as isize;
    let offsets: Vec<(isize, isize)> = (-reach..=reach)
        .flat_map(|y| (-reach..=reach).map(move |x| (x, y)))
        .filter(|(x, y)| ((x * x + y * y) as f64) < radius * radius)
        .collect();
    let mut is_free = vec![false; places.len()];
    let is_reached = |x: isize, y: isize| {
        let inside = x >= 0 && y >= 0 && x < width as isize && y < height as isize;
        inside && places[y as usize * width + x as usize] == Place::Reached
    };
    for cell in (0..places.len()).filter(|cell| places[*cell] == Place::Reached) {
        is_free[cell] = true;
        let (x, y) = ((cell % width) as isize, (cell / width) as isize);
        // Inside the reached area all cells are already free.
        if [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(dx, dy)| is_reached(x + dx, y + dy)) {
            continue;
        }
        for (dx, dy) in &offsets {
            let (x, y) = (x + dx, y + dy);
            if x >= 0 && y >= 0 && x < width as isize && y < height as isize {
                is_free[y as usize * width + x as usize] = true;
            }
        }
    }
    is_free
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::answers::header;

    fn map(size: [usize; 2], runs: &str, cell_m: f64, radius_m: f64) -> OccupancyGrid {
        let (frame, origin_in_world, runs) = ("world".into(), DVec3::new(1.0, 2.0, 0.5), runs.to_owned());
        let floor = Floor { generation: 1, frame, cell_m, origin_in_world, size, runs };
        grid(header("map"), &floor, radius_m).expect("a map")
    }

    /// By hand, cells of 0.25 m and a robot of 0.26 m: the ground beside the reached cell is free; the table top (g
    /// after o) and ground farther away are unknown.
    #[test]
    fn only_ground_under_the_robot_is_free() {
        let grid = map([7, 3], "g7g1r1g1o1g1o1u1g7", 0.25, 0.26);
        assert_eq!((grid.info.width, grid.info.height, grid.info.resolution), (5, 3, 0.25));
        let expected = [[-1, 0, -1, -1, -1], [0, 0, 0, 100, -1], [-1, 0, -1, -1, -1]];
        assert_eq!(grid.data, expected.concat());
        assert_eq!(<[f64; 3]>::from(grid.info.origin.position), [1.0, 2.0, 0.5]);
    }

    /// By hand: a million cells become at most 60,000; a one-cell obstacle stays; free ones are free throughout.
    #[test]
    fn large_maps_are_joined() {
        let grid = map([1000, 1000], "r500500o1r499499", 0.05, 0.0);
        assert_eq!((grid.info.width, grid.info.height), (200, 200));
        assert!((grid.info.resolution - 0.25).abs() < 1e-6);
        let occupied: Vec<usize> = (0..40_000).filter(|cell| grid.data[*cell] == 100).collect();
        // The obstacle is cell (500, 500).
        assert_eq!(occupied, [100 * 200 + 100]);
        assert_eq!(grid.data.iter().filter(|cell| **cell == 0).count(), 39_999);
    }
}
