//! Near, beside and between.

use super::measure::falling;
use super::outline::to_segment;
use super::solid::Solid;

/// Distance of the surfaces, in metres, that is near beyond doubt.
const NEAR_M: f64 = 0.5;
/// Distance that is not near any more; large things are near from farther away.
const FAR_M: f64 = 1.5;
/// Share of the smaller thing's size that is added to both.
const OF_SIZE: f64 = 0.5;
/// The same for things beside each other.
const BESIDE_M: [f64; 2] = [0.4, 1.2];
/// Share of the lower thing's height that both must have in common.
const LEVEL: [f64; 2] = [0.5, 0.1];
/// A thing between two others is off the line from one to the other by at most this share of its length.
const OFF_LINE: [f64; 2] = [0.2, 0.5];

/// Returns the degree to which two things are near each other.
pub fn near(thing: &Solid, other: &Solid, metre: f64) -> f64 {
    let more = OF_SIZE * thing.half.max_element().min(other.half.max_element());
    falling(thing.gap(other), NEAR_M * metre + more, FAR_M * metre + more)
}

/// Returns the degree to which two things stand side by side.
pub fn beside(thing: &Solid, other: &Solid, metre: f64) -> f64 {
    let lower = thing.height().min(other.height()).max(f64::MIN_POSITIVE);
    let level = falling(-thing.shared_height(other) / lower, -LEVEL[0], -LEVEL[1]);
    let smaller = thing.area().min(other.area()).max(f64::MIN_POSITIVE);
    let apart = falling(thing.shared_area(other) / smaller, 0.2, 0.6);
    level * apart * falling(thing.horizontal_gap(other), BESIDE_M[0] * metre, BESIDE_M[1] * metre)
}

/// Returns the degree to which a thing is between two others.
pub fn between(thing: &Solid, one: &Solid, other: &Solid) -> f64 {
    let (from, to) = (one.centre.truncate(), other.centre.truncate());
    let length = from.distance(to);
    if length <= f64::MIN_POSITIVE {
        return 0.0;
    }
    let at = thing.centre.truncate();
    let share = (at - from).dot(to - from) / (length * length);
    // Full in the middle, none beyond the ends.
    let inside = falling((share - 0.5).abs(), 0.35, 0.5);
    inside * falling(to_segment(at, (from, to)) / length, OFF_LINE[0], OFF_LINE[1])
}
