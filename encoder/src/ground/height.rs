//! The height of the ground, tile by tile.

use std::collections::BTreeMap;

use glam::DVec3;
use slag_math::stats::{median, trimmed_range};

/// Side of a tile, in resolutions of the splat: 2.5 m in a survey from 40 m.
const TILE: f64 = 36.0;
const MAX_TILES: f64 = 512.0;
/// Height of a level, over which surface is summed, resolutions.
const LEVEL: f64 = 1.5;
/// A tile's ground is the level with most surface, or one at least this far below it with at least this share of that:
/// a floor below its ceiling. Gaussians that fill the ground lie closer below it.
const BELOW_LEVELS: i64 = 20;
const BELOW_SHARE: f64 = 0.4;
/// Levels on each side that the ground is averaged over: a slope fills several.
const NEAR: i64 = 2;
/// Tiles on each side that determine a tile's ground: roofs and gaps are fewer than half of 9 x 9.
const AROUND: usize = 4;
/// A slope fills several levels of a tile in the first round, and is flat in the second.
const ROUNDS: usize = 2;
/// Share of the Gaussians left out of the tiles at each end.
const TRIMMED: f64 = 0.005;

#[derive(Debug)]
pub(super) struct Ground {
    tile: f64,
    low: [f64; 2],
    n: [usize; 2],
    /// `[n[1]][n[0]]`; NaN where nothing is near.
    heights: Vec<f64>,
    pub(super) width: f64,
}

impl Ground {
    /// Finds the ground below points (z up), each with its area of surface. `None` without points.
    pub(super) fn find(points: &[(DVec3, f64)], resolution: f64) -> Option<Self> {
        let range = |axis: usize| {
            let mut along: Vec<f64> = points.iter().map(|(point, _)| point[axis]).collect();
            trimmed_range(&mut along, TRIMMED)
        };
        let [x, y, z] = [range(0)?, range(1)?, range(2)?];
        let width = (x.1 - x.0).max(y.1 - y.0);
        let tile = (TILE * resolution).max(width / MAX_TILES);
        if !(tile > 0.0 && tile.is_finite()) {
            return None;
        }
        let n = [x, y].map(|(low, high)| ((high - low) / tile).ceil().max(1.0) as usize);
        let heights = vec![z.0; n[0] * n[1]];
        let mut ground = Self { tile, low: [x.0, y.0], n, heights, width };
        let points: Vec<(DVec3, f64)> =
            points.iter().copied().filter(|point| (z.0..=z.1).contains(&point.0.z)).collect();
        for _ in 0..ROUNDS {
            ground.measure(&points, LEVEL * resolution);
        }
        Some(ground)
    }

    /// Measures the ground again, relative to the previous estimate.
    fn measure(&mut self, points: &[(DVec3, f64)], level: f64) {
        let mut areas: Vec<BTreeMap<i64, f64>> = vec![BTreeMap::new(); self.heights.len()];
        for (point, area) in points {
            let at = [0, 1].map(|axis| (point[axis] - self.low[axis]) / self.tile);
            if (0..2).all(|axis| at[axis] >= 0.0 && at[axis] < self.n[axis] as f64) {
                let of_tile = &mut areas[at[1] as usize * self.n[0] + at[0] as usize];
                let at = (self.height_of(*point) / level).floor() as i32;
                *of_tile.entry(at.into()).or_default() += area;
            }
        }
        let height = |areas| ground_level(areas).map_or(f64::NAN, |at| (at + 0.5) * level);
        let of_tiles: Vec<f64> = areas.iter().map(height).collect();
        self.heights.iter_mut().zip(planes(&of_tiles, self.n)).for_each(|(height, above)| *height += above);
    }

    /// Height of a point above the ground; NaN where none is near.
    pub(super) fn height_of(&self, point: DVec3) -> f64 {
        let axis = |i: usize| {
            let last = self.n[i] as f64 - 1.0;
            let at = ((point[i] - self.low[i]) / self.tile - 0.5).clamp(0.0, last);
            (at as usize, (at as usize + 1).min(self.n[i] - 1), at.fract())
        };
        let ((x0, x1, right), (y0, y1, down)) = (axis(0), axis(1));
        let at = |x: usize, y: usize| self.heights[y * self.n[0] + x];
        let row = |y: usize| at(x0, y) + right * (at(x1, y) - at(x0, y));
        point.z - (row(y0) + down * (row(y1) - row(y0)))
    }
}

fn ground_level(areas: &BTreeMap<i64, f64>) -> Option<f64> {
    let at = |level: i64| areas.get(&level).copied().unwrap_or(0.0);
    let around = |level: &i64| (*level, at(level - 1) + at(*level) + at(level + 1));
    let most_below = |end: i64| {
        areas.range(..end).map(|(level, _)| around(level)).reduce(|a, b| if b.1 > a.1 { b } else { a })
    };
    let (mut ground, most) = most_below(i64::MAX)?;
    while let Some((lower, area)) = most_below(ground - BELOW_LEVELS) {
        if area < BELOW_SHARE * most {
            break;
        }
        ground = lower;
    }
    let near = || areas.range(ground - NEAR..=ground + NEAR);
    let sum: f64 = near().map(|(level, area)| *level as f64 * area).sum();
    Some(sum / near().map(|(_, area)| area).sum::<f64>())
}

/// Height of each tile on a plane through its neighbours: slopes and height are medians, robust to roofs and gaps.
fn planes(of_tiles: &[f64], n: [usize; 2]) -> Vec<f64> {
    let around = |at: usize, n: usize| at.saturating_sub(AROUND)..(at + AROUND + 1).min(n);
    let of_tile = |x: usize, y: usize| {
        let (columns, rows) = (around(x, n[0]), around(y, n[1]));
        let at = |column: usize, row: usize| of_tiles[row * n[0] + column];
        let middle = |values: &mut dyn Iterator<Item = f64>| {
            median(&mut values.filter(|value| !value.is_nan()).collect::<Vec<f64>>())
        };
        let tiles = || rows.clone().flat_map(|row| columns.clone().map(move |column| (column, row)));
        let right = |(column, row): (usize, usize)| {
            columns.contains(&(column + 1)).then(|| at(column + 1, row) - at(column, row))
        };
        let down = |(column, row): (usize, usize)| {
            rows.contains(&(row + 1)).then(|| at(column, row + 1) - at(column, row))
        };
        let slopes = [middle(&mut tiles().filter_map(right)), middle(&mut tiles().filter_map(down))];
        let [right, down] = slopes.map(Option::unwrap_or_default);
        let level = |(column, row): (usize, usize)| {
            at(column, row) + right * (x as f64 - column as f64) + down * (y as f64 - row as f64)
        };
        middle(&mut tiles().map(level)).unwrap_or(f64::NAN)
    };
    (0..n[1]).flat_map(|y| (0..n[0]).map(move |x| of_tile(x, y))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slope of 1 in 10, 300 resolutions wide, one point per resolution.
    fn slope() -> Vec<(DVec3, f64)> {
        let at = |i: u32| DVec3::new(f64::from(i % 300), f64::from(i / 300), f64::from(i % 300) / 10.0);
        (0..90_000).map(|i| (at(i), 1.0)).collect()
    }

    /// By hand: a height is within a level of that above the slope, whatever stands on it or lies below.
    #[test]
    fn ground_is_a_slope_below_its_things_and_above_what_fills_it() {
        let mut points = slope();
        let all: Vec<(DVec3, f64)> = points.clone();
        let is_roof = |p: &DVec3| (100.0..160.0).contains(&p.x) && (100.0..160.0).contains(&p.y);
        points.extend(all.iter().filter(|(p, _)| is_roof(p)).map(|(p, _)| (p.with_z(p.z + 40.0), 3.0)));
        points.extend(all.iter().map(|(p, _)| (p.with_z(p.z - 7.0), 0.6)));
        let ground = Ground::find(&points, 1.0).expect("a ground");
        for at in [[130.0, 130.0], [60.0, 200.0], [240.0, 40.0]] {
            let point = DVec3::new(at[0], at[1], at[0] / 10.0 + 10.0);
            assert!(
                (ground.height_of(point) - 10.0).abs() < 2.0 * LEVEL,
                "{at:?}: {}",
                ground.height_of(point)
            );
        }
    }

    /// By hand: a room's floor shows half of its ceiling's surface, for furniture hides the rest.
    #[test]
    fn floor_is_the_ground_not_its_ceiling() {
        let flat = |z: f64, area: f64| {
            (0..40_000).map(move |i| (DVec3::new(f64::from(i % 200), f64::from(i / 200), z), area))
        };
        let room: Vec<(DVec3, f64)> = flat(0.0, 0.5).chain(flat(120.0, 1.0)).collect();
        let ground = Ground::find(&room, 1.0).expect("a ground");
        assert!((ground.height_of(DVec3::new(100.0, 100.0, 5.0)) - 5.0).abs() < LEVEL);
    }
}
