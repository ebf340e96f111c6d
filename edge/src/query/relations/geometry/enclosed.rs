//! In: one thing inside another.

use super::measure::falling;
use super::solid::Solid;

/// Metres by which a thing may stick out of the box that it is in.
const SLACK_M: f64 = 0.1;
/// Shares of a thing's box that lie inside: the relation holds fully from the first, not at all from the second.
const INSIDE: [f64; 2] = [0.8, 0.4];
/// A thing is smaller than this share of what it is in.
const SMALLER: f64 = 0.5;

/// Returns the degree to which a thing is inside another.
pub fn inside(thing: &Solid, container: &Solid, metre: f64) -> f64 {
    if thing.volume() >= SMALLER * container.volume() {
        return 0.0;
    }
    let container = container.grown(SLACK_M * metre);
    let of_outline = thing.shared_area(&container) / thing.area().max(f64::MIN_POSITIVE);
    let of_height = thing.shared_height(&container).max(0.0) / thing.height().max(f64::MIN_POSITIVE);
    falling(-(of_outline * of_height).min(1.0), -INSIDE[0], -INSIDE[1])
}
