//! The length of the path to each place.

use rayon::prelude::*;

use super::ground::{Floor, Ground};

/// Cost of a step along an axis; diagonal ones cost 17: the ratio is within 0.2 % of the square root of 2.
const STRAIGHT: u32 = 12;
const DIAGONAL: u32 = 17;
pub const UNREACHED: u32 = u32::MAX;

/// Height of a place closed to the robot's middle; others are below 128, and steps at most 100.
const CLOSED: u8 = u8::MAX;

/// Shortest paths from a robot over safe cells in eight directions, between neighbours at most a step apart
/// in height: Dijkstra's algorithm with Dial's buckets, as lengths are integers and a step costs at most 17.
pub struct Paths {
    n_y: usize,
    /// By cell, with a border of closed ones: length in twelfths of a cell, or [`UNREACHED`].
    lengths: Vec<u32>,
}

impl Paths {
    /// Finds the paths from a safe cell. `step`: in voxels.
    pub fn from(start: usize, is_safe: &[bool], ground: &Ground, step: u8) -> Self {
        let n_y = ground.n_y;
        let width = n_y + 2;
        let mut heights = vec![CLOSED; (is_safe.len() / n_y + 2) * width];
        let rows = heights[width..].par_chunks_mut(width);
        rows.zip(is_safe.par_chunks(n_y)).zip(ground.floors.par_chunks(n_y)).for_each(
            |((row, safe), floors)| {
                for ((height, is_safe), floor) in row[1..].iter_mut().zip(safe).zip(floors) {
                    if let (true, Floor::At(z)) = (is_safe, floor) {
                        *height = *z;
                    }
                }
            },
        );
        let beside = [(1, STRAIGHT), (width, STRAIGHT), (width - 1, DIAGONAL), (width + 1, DIAGONAL)];
        let beside = [beside, beside.map(|(offset, cost)| (offset.wrapping_neg(), cost))].concat();
        let mut paths = Self { n_y, lengths: vec![UNREACHED; heights.len()] };
        let start = paths.bordered(start);
        paths.lengths[start] = 0;
        // Cells by the remainder of their length.
        let mut buckets: [Vec<u32>; DIAGONAL as usize + 1] = Default::default();
        buckets[0].push(start as u32);
        let (mut length, mut n_waiting) = (0u32, 1);
        while n_waiting > 0 {
            let bucket = length as usize % buckets.len();
            let mut cells = std::mem::take(&mut buckets[bucket]);
            n_waiting -= cells.len();
            for cell in cells.drain(..).map(|cell| cell as usize) {
                if paths.lengths[cell] != length {
                    continue;
                }
                for (offset, cost) in &beside {
                    let (to, next) = (cell.wrapping_add(*offset), length + cost);
                    if heights[to].abs_diff(heights[cell]) <= step && next < paths.lengths[to] {
                        paths.lengths[to] = next;
                        buckets[next as usize % buckets.len()].push(to as u32);
                        n_waiting += 1;
                    }
                }
            }
            buckets[bucket] = cells;
            length += 1;
        }
        paths
    }

    fn bordered(&self, cell: usize) -> usize {
        (cell / self.n_y + 1) * (self.n_y + 2) + cell % self.n_y + 1
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
                let found = Paths::from(start, &is_safe, &ground, 1);
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
                for (cell, expected) in expected.iter().enumerate() {
                    let found = found.to(cell).unwrap_or(f64::INFINITY);
                    let holds = found == *expected || (found - expected).abs() < 1e-9;
                    assert!(holds, "{cell}: {found} {expected}");
                }
            }
        }
    }
}
