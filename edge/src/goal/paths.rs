//! The length of the way to each place.

use super::ground::{Floor, Ground};

/// Cost of a step to a neighbour along an axis; diagonal ones cost 17: their ratio is within 0.2 % of the square root of 2.
const STRAIGHT: u32 = 12;
const DIAGONAL: u32 = 17;
/// No way leads here.
pub const UNREACHED: u32 = u32::MAX;

/// The ways from a robot to the places that it reaches.
pub struct Paths {
    /// By cell: length in twelfths of a cell, or [`UNREACHED`].
    lengths: Vec<u32>,
}

impl Paths {
    /// Finds the shortest ways over safe cells from one of them, along eight directions; neighbours may differ by a step of
    /// `step` voxels (Dijkstra's algorithm with Dial's buckets: lengths are whole numbers, and a step costs at most 17).
    pub fn from(start: usize, is_safe: &[bool], ground: &Ground, step: u8) -> Self {
        let n_y = ground.n_y;
        let mut lengths = vec![UNREACHED; is_safe.len()];
        let mut buckets: [Vec<u32>; DIAGONAL as usize + 1] = Default::default();
        lengths[start] = 0;
        buckets[0].push(start as u32);
        let (mut length, mut n_waiting) = (0u32, 1usize);
        let n_buckets = buckets.len();
        while n_waiting > 0 {
            while let Some(cell) = buckets[length as usize % n_buckets].pop() {
                n_waiting -= 1;
                let cell = cell as usize;
                if lengths[cell] != length {
                    continue;
                }
                let Floor::At(here) = ground.floors[cell] else { continue };
                let y = cell % n_y;
                for (dx, dy) in [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)] {
                    if dy < 0 && y == 0 || dy > 0 && y + 1 == n_y {
                        continue;
                    }
                    let beside = cell as i64 + i64::from(dx) * n_y as i64 + i64::from(dy);
                    let Some(beside) =
                        usize::try_from(beside).ok().filter(|at| is_safe.get(*at) == Some(&true))
                    else {
                        continue;
                    };
                    let is_step =
                        matches!(ground.floors[beside], Floor::At(there) if here.abs_diff(there) <= step);
                    let next = length + if dx != 0 && dy != 0 { DIAGONAL } else { STRAIGHT };
                    if is_step && next < lengths[beside] {
                        lengths[beside] = next;
                        buckets[next as usize % n_buckets].push(beside as u32);
                        n_waiting += 1;
                    }
                }
            }
            length += 1;
        }
        Self { lengths }
    }

    /// Returns the length of the way to a cell, in cells; `None` if no way leads there.
    pub fn to(&self, cell: usize) -> Option<f64> {
        let length = self.lengths[cell];
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
                let ground = Ground { floors: floors.clone(), n_y };
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
                    assert!(
                        found == *expected || (found - expected).abs() < 1e-9,
                        "{cell}: {found} {expected}"
                    );
                }
            }
        }
    }
}
