//! The distance of each place to what the robot must not touch.

use rayon::prelude::*;
use slag_math::distance_transform::{Envelope, along_row};

use super::ground::{Floor, Ground};

/// Returns which cells the robot must not touch: those without ground, and those with a drop beside them that is higher than a
/// step (in voxels).
///
/// It is the upper side of a drop that counts, so a robot may drive along below a ledge, and never onto it or off it.
pub fn obstacles(ground: &Ground, step: u8) -> Vec<bool> {
    let (floors, n_y) = (&ground.floors, ground.n_y);
    let mut obstacles = vec![false; floors.len()];
    obstacles.par_chunks_mut(n_y.max(1)).enumerate().for_each(|(x, row)| {
        for (y, is_obstacle) in row.iter_mut().enumerate() {
            let cell = x * n_y + y;
            let Floor::At(here) = floors[cell] else {
                *is_obstacle = true;
                continue;
            };
            let drops = |beside: Option<&Floor>| matches!(beside, Some(Floor::At(z)) if here > z.saturating_add(step));
            let before = |distance: usize| cell.checked_sub(distance).and_then(|at| floors.get(at));
            *is_obstacle = drops(before(n_y))
                || drops(floors.get(cell + n_y))
                || y > 0 && drops(before(1))
                || y + 1 < n_y && drops(floors.get(cell + 1));
        }
    });
    obstacles
}

/// Returns the squared distance of each cell to the nearest obstacle, in cells; places outside the grid are obstacles.
pub fn squared_distances(obstacles: &[bool], n_y: usize) -> Vec<u32> {
    let n_x = obstacles.len().checked_div(n_y).unwrap_or(0);
    // A border of obstacles on all four sides.
    let (width, height) = (n_y + 2, n_x + 2);
    let mut rows = vec![0u32; width * height];
    rows.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
        let of_row =
            row.checked_sub(1).and_then(|x| obstacles.get(x * n_y..(x + 1) * n_y)).unwrap_or_default();
        let at = |y: usize| y.checked_sub(1).and_then(|y| of_row.get(y)).copied().unwrap_or(true);
        along_row((0..width).map(at), out);
    });
    let columns = transposed(&rows, width);
    let mut lowest = rows;
    let of_columns = lowest.par_chunks_mut(height).zip(columns.par_chunks(height));
    of_columns.for_each_init(Envelope::default, |envelope, (out, column)| envelope.lowest(column, out));
    let rows = transposed(&lowest, height);
    (0..n_x).flat_map(|x| rows[(x + 1) * width + 1..][..n_y].iter().copied()).collect()
}

/// Returns a grid with rows and columns exchanged, in tiles that fit the cache.
fn transposed(rows: &[u32], width: usize) -> Vec<u32> {
    const TILE: usize = 32;
    let height = rows.len() / width.max(1);
    let mut columns = vec![0; rows.len()];
    columns.par_chunks_mut(TILE * height.max(1)).enumerate().for_each(|(tile, out)| {
        let xs = tile * TILE..width.min((tile + 1) * TILE);
        for y0 in (0..height).step_by(TILE) {
            for x in xs.clone() {
                for y in y0..height.min(y0 + TILE) {
                    out[(x - tile * TILE) * height + y] = rows[y * width + x];
                }
            }
        }
    });
    columns
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    /// Oracle: every obstacle, and every place just outside the grid, compared with every cell.
    #[test]
    fn distances_are_exact() {
        let mut random = Random::new(2);
        for (n_x, n_y) in [(1usize, 1usize), (5, 70), (70, 5), (33, 40)] {
            let obstacles: Vec<bool> = (0..n_x * n_y).map(|_| random.unit() < 0.01).collect();
            let found = squared_distances(&obstacles, n_y);
            let inside = |x: i64, y: i64| x >= 0 && y >= 0 && x < n_x as i64 && y < n_y as i64;
            let places = (-1..=n_x as i64).flat_map(|x| (-1..=n_y as i64).map(move |y| (x, y)));
            let all: Vec<(i64, i64)> = places
                .filter(|(x, y)| !inside(*x, *y) || obstacles[*x as usize * n_y + *y as usize])
                .collect();
            for (cell, found) in found.iter().enumerate() {
                let (x, y) = ((cell / n_y) as i64, (cell % n_y) as i64);
                let least = all.iter().map(|(a, b)| (a - x).pow(2) + (b - y).pow(2)).min();
                assert_eq!(Some(i64::from(*found)), least, "{n_x} x {n_y}: {cell}");
            }
        }
    }

    /// By hand: a ramp of one voxel a cell, a ledge of three.
    #[test]
    fn the_upper_side_of_a_drop_is_an_obstacle() {
        let floors = [1, 2, 3, 6, 6, 6].map(Floor::At).to_vec();
        assert_eq!(obstacles(&Ground { floors, n_y: 6 }, 2), [false, false, false, true, false, false]);
        let floors =
            vec![Floor::At(5), Floor::Unknown, Floor::At(9), Floor::At(1), Floor::Blocked, Floor::At(1)];
        // Two rows of three: the drops are along x.
        assert_eq!(obstacles(&Ground { floors, n_y: 3 }, 2), [true, true, true, false, true, false]);
    }
}
