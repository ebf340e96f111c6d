//! The length of the path to each place.

use rayon::prelude::*;

use super::ground::{Floor, Ground};

/// Cost of a step along an axis; diagonal ones cost 17: the ratio is within 0.2 % of the square root of 2.
const STRAIGHT: u32 = 12;
const DIAGONAL: u32 = 17;
pub const UNREACHED: u32 = u32::MAX;

/// Most connected places (10 m² in voxels of 5 cm) checked before a search for a path to one of them: tops of
/// things have none, so the search would go everywhere.
const MAX_CONNECTED: usize = 4096;

/// Height of a place closed to the robot's middle; others are below 128, and steps at most 100.
const CLOSED: u8 = u8::MAX;

/// Shortest paths from a robot over safe cells in eight directions, between neighbours at most a step apart
/// in height: Dijkstra's algorithm with Dial's buckets, as lengths are integers and a step costs at most 17.
/// The search advances only as far as it is asked for.
pub struct Paths {
    /// By cell, with a border of closed ones: height of the ground.
    heights: Vec<u8>,
    /// By cell, with the border: whether it is connected with a path or with many cells.
    is_open: Vec<bool>,
    n_y: usize,
    step: u8,
    /// By cell, with the border: length in twelfths of a cell, or [`UNREACHED`]; final if below `length`.
    lengths: Vec<u32>,
    /// Cells by the remainder of their length.
    buckets: [Vec<u32>; DIAGONAL as usize + 1],
    length: u32,
    n_waiting: usize,
}

impl Paths {
    /// Begins at a safe cell. `step`: in voxels.
    pub fn from(start: usize, is_safe: &[bool], ground: &Ground, step: u8) -> Self {
        let n_y = ground.n_y;
        let mut heights = vec![CLOSED; (is_safe.len() / n_y + 2) * (n_y + 2)];
        let rows = heights[n_y + 2..].par_chunks_mut(n_y + 2);
        rows.zip(is_safe.par_chunks(n_y)).zip(ground.floors.par_chunks(n_y)).for_each(
            |((row, safe), floors)| {
                for ((height, is_safe), floor) in row[1..].iter_mut().zip(safe).zip(floors) {
                    if let (true, Floor::At(z)) = (is_safe, floor) {
                        *height = *z;
                    }
                }
            },
        );
        let lengths = vec![UNREACHED; heights.len()];
        let is_open = vec![false; heights.len()];
        let buckets = Default::default();
        let mut paths = Self { heights, is_open, n_y, step, lengths, buckets, length: 0, n_waiting: 1 };
        let start = paths.bordered(start);
        paths.lengths[start] = 0;
        paths.buckets[0].push(start as u32);
        paths
    }

    fn bordered(&self, cell: usize) -> usize {
        (cell / self.n_y + 1) * (self.n_y + 2) + cell % self.n_y + 1
    }

    pub fn find(&mut self, cells: impl IntoIterator<Item = usize>) {
        for cell in cells {
            let cell = self.bordered(cell);
            if self.n_waiting > 0 && self.lengths[cell] == UNREACHED {
                self.close_island(cell, MAX_CONNECTED);
            }
            while self.n_waiting > 0 && self.heights[cell] != CLOSED && self.lengths[cell] >= self.length {
                self.find_next();
            }
        }
    }

    fn beside(&self) -> [(usize, u32); 8] {
        let width = self.n_y + 2;
        [
            (width.wrapping_neg(), STRAIGHT),
            (1usize.wrapping_neg(), STRAIGHT),
            (1, STRAIGHT),
            (width, STRAIGHT),
            ((width + 1).wrapping_neg(), DIAGONAL),
            ((width - 1).wrapping_neg(), DIAGONAL),
            (width - 1, DIAGONAL),
            (width + 1, DIAGONAL),
        ]
    }

    /// Closes the cells connected with a cell if they are at most `most` and no path has reached any: none will.
    fn close_island(&mut self, cell: usize, most: usize) {
        if self.heights[cell] == CLOSED || self.is_open[cell] {
            return;
        }
        let beside = self.beside();
        let mut connected = vec![(cell, self.heights[cell])];
        self.heights[cell] = CLOSED;
        let mut is_open = false;
        let mut next = 0;
        while let (false, Some((cell, here))) = (is_open, connected.get(next).copied()) {
            for to in beside.map(|(offset, _)| cell.wrapping_add(offset)) {
                let height = self.heights[to];
                if height.abs_diff(here) <= self.step {
                    is_open |= self.is_open[to] || self.lengths[to] != UNREACHED;
                    self.heights[to] = CLOSED;
                    connected.push((to, height));
                }
            }
            is_open |= connected.len() > most;
            next += 1;
        }
        if is_open {
            for (cell, height) in connected {
                self.heights[cell] = height;
                self.is_open[cell] = true;
            }
        }
    }

    /// Settles the cells of the next length.
    fn find_next(&mut self) {
        let beside = self.beside();
        let n_buckets = self.buckets.len();
        let mut cells = std::mem::take(&mut self.buckets[self.length as usize % n_buckets]);
        self.n_waiting -= cells.len();
        for cell in cells.drain(..).map(|cell| cell as usize) {
            if self.lengths[cell] != self.length {
                continue;
            }
            let here = self.heights[cell];
            for (offset, cost) in beside {
                let (to, next) = (cell.wrapping_add(offset), self.length + cost);
                if self.heights[to].abs_diff(here) <= self.step && next < self.lengths[to] {
                    self.lengths[to] = next;
                    self.buckets[next as usize % n_buckets].push(to as u32);
                    self.n_waiting += 1;
                }
            }
        }
        self.buckets[self.length as usize % n_buckets] = cells;
        self.length += 1;
    }

    /// Returns the length of the path to a cell, in cells; `None` if there is none.
    pub fn to(&self, cell: usize) -> Option<f64> {
        let length = self.lengths[self.bordered(cell)];
        (length != UNREACHED).then(|| f64::from(length) / f64::from(STRAIGHT))
    }
}

#[cfg(test)]
mod tests {
    use slag_math::random::Random;

    use super::*;

    /// Oracle: lengths relaxed over all pairs of neighbours until nothing changes (Bellman and Ford).
    #[test]
    fn lengths_are_the_shortest() {
        let mut random = Random::new(12);
        for (n_x, n_y) in [(1usize, 9usize), (9, 1), (14, 11)] {
            for _ in 0..20 {
                let n = n_x * n_y;
                let floors: Vec<Floor> = (0..n).map(|_| Floor::At(random.below(4u8))).collect();
                let is_safe: Vec<bool> = (0..n).map(|_| random.unit() < 0.8).collect();
                let Some(start) = is_safe.iter().position(|safe| *safe) else { continue };
                let ground = Ground::of(floors.clone(), n_y);
                let mut found = Paths::from(start, &is_safe, &ground, 1);
                let mut expected = vec![f64::INFINITY; n];
                expected[start] = 0.0;
                for _ in 0..n {
                    for (a, b) in (0..n).flat_map(|a| (0..n).map(move |b| (a, b))) {
                        let (dx, dy) = ((a / n_y).abs_diff(b / n_y), (a % n_y).abs_diff(b % n_y));
                        let (Floor::At(za), Floor::At(zb)) = (floors[a], floors[b]) else { continue };
                        if dx.max(dy) == 1 && is_safe[a] && is_safe[b] && za.abs_diff(zb) <= 1 {
                            let step = if dx + dy == 2 { 17.0 / 12.0 } else { 1.0 };
                            expected[b] = expected[b].min(expected[a] + step);
                        }
                    }
                }
                for most in [3, 8] {
                    (0..n).for_each(|cell| {
                        let cell = found.bordered(cell);
                        if found.lengths[cell] == UNREACHED {
                            found.close_island(cell, most);
                        }
                    });
                }
                // One by one, so the search resumes each time.
                for (cell, expected) in expected.iter().enumerate() {
                    found.find([cell]);
                    let found = found.to(cell).unwrap_or(f64::INFINITY);
                    assert!(
                        found == *expected || (found - expected).abs() < 1e-9,
                        "{cell}: {found} {expected}"
                    );
                }
            }
        }
    }
}
