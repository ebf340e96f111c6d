//! The distance of each place to what the robot must not touch.

use rayon::prelude::*;
use slag_math::distance_transform::along_row;

use super::ground::{Floor, Ground};

/// Stands for the height of a cell without ground; heights are below 128.
const NO_GROUND: u8 = u8::MAX;

/// Returns the cells that the robot must not touch: without ground, or beside a drop higher than a step (in voxels).
///
/// The upper side of a drop counts: a robot may drive along below a ledge, but never onto or off it.
pub fn obstacles(ground: &Ground, step: u8) -> Vec<bool> {
    let (floors, n_y) = (&ground.floors, ground.n_y);
    let mut obstacles = vec![false; floors.len()];
    obstacles.par_chunks_mut(n_y.max(1)).enumerate().for_each(|(x, row)| {
        // Heights of a row of the grid, with a border.
        let heights = |x: Option<usize>| {
            let of_row = x.and_then(|x| floors.get(x * n_y..(x + 1) * n_y)).unwrap_or_default();
            let mut heights = vec![NO_GROUND; n_y + 2];
            for (height, floor) in heights[1..].iter_mut().zip(of_row) {
                *height = if let Floor::At(z) = floor { *z } else { NO_GROUND };
            }
            heights
        };
        let [before, here, after] = [x.checked_sub(1), Some(x), Some(x + 1)].map(heights);
        let beside = here.iter().zip(&here[2..]).zip(before[1..].iter().zip(&after[1..]));
        for ((is_obstacle, here), ((a, b), (c, d))) in row.iter_mut().zip(&here[1..]).zip(beside) {
            let lowest = *a.min(b).min(c).min(d);
            *is_obstacle = *here == NO_GROUND || *here > lowest.saturating_add(step);
        }
    });
    obstacles
}

/// The exact distance of each cell to the nearest obstacle; places outside the grid are obstacles.
pub struct Clearance {
    /// `[n_x][n_y]`: squared distance along y.
    along_y: Vec<u32>,
    n_y: usize,
}

impl Clearance {
    /// Measures along y; distances along x are computed for the cells asked for.
    pub fn new(obstacles: &[bool], n_y: usize) -> Self {
        let mut along_y = vec![0u32; obstacles.len()];
        along_y.par_chunks_mut(n_y.max(1)).zip(obstacles.par_chunks(n_y.max(1))).for_each(|(out, row)| {
            along_row(row.iter().copied(), out);
            for (y, out) in out.iter_mut().enumerate() {
                let border = (y + 1).min(n_y - y) as u32;
                *out = (*out).min(border * border);
            }
        });
        Self { along_y, n_y }
    }

    pub fn is_obstacle(&self, cell: usize) -> bool {
        self.along_y[cell] == 0
    }

    pub fn squared(&self, cell: usize) -> u32 {
        let (x, y) = (cell / self.n_y, cell % self.n_y);
        let n_x = self.along_y.len() / self.n_y;
        let border = (x + 1).min(n_x - x);
        let mut least = (border * border) as u32;
        // The border itself is an obstacle, so nothing nearer lies beyond it.
        for distance in 0..border {
            let of_rows = (distance * distance) as u32;
            if of_rows >= least {
                break;
            }
            let nearer = [x - distance, x + distance].map(|x| self.along_y[x * self.n_y + y]);
            least = least.min(of_rows + nearer[0].min(nearer[1]));
        }
        least
    }

    /// Returns which cells have a squared distance of at least `least`, 1 or more.
    pub(crate) fn at_least(&self, least: u32) -> Vec<bool> {
        let n_x = self.along_y.len().checked_div(self.n_y).unwrap_or(0) as i64;
        let reach = i64::from((least - 1).isqrt());
        let mut is_clear = vec![false; self.along_y.len()];
        is_clear.par_chunks_mut(self.n_y.max(1)).enumerate().for_each(|(x, row)| {
            let x = x as i64;
            if (x + 1).min(n_x - x) <= reach {
                return;
            }
            row.fill(true);
            for distance in -reach..=reach {
                let along_y = &self.along_y[(x + distance) as usize * self.n_y..][..self.n_y];
                let needed = least - (distance * distance) as u32;
                row.iter_mut().zip(along_y).for_each(|(clear, squared)| *clear &= *squared >= needed);
            }
        });
        is_clear
    }
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
            let clearance = Clearance::new(&obstacles, n_y);
            let is_clear = [1, 2, 5, 9, 30].map(|least| (least, clearance.at_least(least)));
            let inside = |x: i64, y: i64| x >= 0 && y >= 0 && x < n_x as i64 && y < n_y as i64;
            let places = (-1..=n_x as i64).flat_map(|x| (-1..=n_y as i64).map(move |y| (x, y)));
            let all: Vec<(i64, i64)> = places
                .filter(|(x, y)| !inside(*x, *y) || obstacles[*x as usize * n_y + *y as usize])
                .collect();
            for cell in 0..n_x * n_y {
                let (x, y) = ((cell / n_y) as i64, (cell % n_y) as i64);
                let least = all.iter().map(|(a, b)| (a - x).pow(2) + (b - y).pow(2)).min();
                let found = i64::from(clearance.squared(cell));
                assert_eq!(Some(found), least, "{n_x} x {n_y}: {cell}");
                assert_eq!(clearance.is_obstacle(cell), found == 0, "{n_x} x {n_y}: {cell}");
                for (least, is_clear) in &is_clear {
                    assert_eq!(is_clear[cell], found >= i64::from(*least), "{n_x} x {n_y}: {cell}, {least}");
                }
            }
        }
    }

    /// By hand: a ramp of one voxel a cell, a ledge of three.
    #[test]
    fn the_upper_side_of_a_drop_is_an_obstacle() {
        let floors = [1, 2, 3, 6, 6, 6].map(Floor::At).to_vec();
        assert_eq!(obstacles(&Ground::of(floors, 6), 2), [false, false, false, true, false, false]);
        let floors =
            vec![Floor::At(5), Floor::Unknown, Floor::At(9), Floor::At(1), Floor::Blocked, Floor::At(1)];
        // Two rows of three: the drops are along x.
        assert_eq!(obstacles(&Ground::of(floors, 3), 2), [true, true, true, false, true, false]);
    }
}
