//! What a sensor sees of a thing: straight lines through free places.

use glam::DVec3;

use super::space::Space;

/// Distance from a point of the thing within which the line need not be free, in edges of a voxel: the thing's own surface, and
/// the voxels just before it, are occupied or unknown.
pub const TOLERANCE: f64 = 2.0;

/// Returns whether a point is seen: every voxel on the line from the sensor is free up to [`TOLERANCE`] before the point.
///
/// The voxels that a line passes are those of Amanatides and Woo, "A Fast Voxel Traversal Algorithm" (1987). Unknown ones hide
/// what is behind them.
pub fn sees(space: &Space, sensor: DVec3, point: DVec3) -> bool {
    let voxel = space.window.voxel;
    let line = point - sensor;
    let length = line.length();
    let end = length - TOLERANCE * voxel;
    if end <= 0.0 {
        return true;
    }
    let direction = line / length;
    let mut at = space.window.voxel_of(sensor);
    let corner = DVec3::from(space.window.first.map(|b| f64::from(b * 4))) * voxel;
    // Distance along the line to the next side of a voxel, and between two sides.
    let mut next = DVec3::INFINITY;
    let between = (voxel / direction).abs();
    for axis in 0..3 {
        if direction[axis] != 0.0 {
            let side =
                corner[axis] + (f64::from(at[axis]) + f64::from(u8::from(direction[axis] > 0.0))) * voxel;
            next[axis] = (side - sensor[axis]) / direction[axis];
        }
    }
    loop {
        if !space.is_free(at) {
            return false;
        }
        let axis = (0..3).fold(0, |least, axis| if next[axis] < next[least] { axis } else { least });
        if next[axis] >= end {
            return true;
        }
        at[axis] += if direction[axis] > 0.0 { 1 } else { -1 };
        next[axis] += between[axis];
    }
}
