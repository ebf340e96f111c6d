//! Relations as plain geometry of upright boxes: degrees from 0 to 1, holding from [`HOLDS`] on (`docs/api.md`).

mod solid;

use std::f64::consts::FRAC_PI_2;

use glam::{DVec2, DVec3};

use super::phrase::Relation;

use self::solid::to_segment;
pub use solid::Solid;

/// Least degree at which a relation holds.
pub const HOLDS: f64 = 0.5;

/// Returns the degree of a relation; 0 for `between`, see [`between`].
pub fn degree(is: Relation, thing: &Solid, of: &Solid, viewer: Option<&Viewer>, metre: f64) -> f64 {
    match is {
        Relation::On => on(thing, of, metre),
        Relation::Under => under(thing, of, metre),
        Relation::Above => under(of, thing, metre),
        Relation::In => inside(thing, of, metre),
        Relation::Near => near(thing, of, metre),
        Relation::Beside => beside(thing, of, metre),
        Relation::Between => 0.0,
        Relation::LeftOf | Relation::RightOf | Relation::InFrontOf | Relation::Behind => {
            viewer.map_or(0.0, |viewer| towards(is, thing, of, viewer, metre))
        }
    }
}

/// Returns 1 below `full`, 0 above `none`, linear between.
fn falling(value: f64, full: f64, none: f64) -> f64 {
    ((none - value) / (none - full)).clamp(0.0, 1.0)
}

/// Distance, metres, between a thing's bottom and the surface below that still counts as touching: positions are
/// those of Gaussians, and the box excludes the outermost.
const TOUCHES_M: f64 = 0.1;
/// Distance from which it surely does not touch.
const APART_M: f64 = 0.25;
/// As [`TOUCHES_M`] and [`APART_M`] at most, for what stands on legs: boxes lose thin ones.
const LEGS_M: [f64; 2] = [0.3, 0.55];
/// Length of such legs, as a share of the longest edge of the rest: a mug has none.
const LEGS: [f64; 2] = [0.6, 1.0];
/// Share of the support's height by which a thing's bottom may lie below its top: seats are lower than backs, and
/// masks of a support may include what stands on it.
const SUNK: f64 = 0.6;
/// Share of a thing's outline that must lie over its support.
const OVER: [f64; 2] = [0.6, 0.2];
/// A panel, such as a wall, is thinner than this share of its width.
const PANEL: f64 = 0.25;

/// Returns the degree to which a thing rests on another, or hangs on it if that is a panel.
fn on(thing: &Solid, support: &Solid, metre: f64) -> f64 {
    resting(thing, support, metre).max(hanging(thing, support, metre))
}

fn resting(thing: &Solid, support: &Solid, metre: f64) -> f64 {
    // A thing much larger than its support rests on something else.
    if thing.area() > 2.0 * support.area() || thing.centre.z <= support.centre.z {
        return 0.0;
    }
    let over = thing.shared_area(support) / thing.area().max(f64::MIN_POSITIVE);
    let gap = thing.bottom() - support.top();
    let sunk = -gap / (SUNK * support.height()).max(TOUCHES_M * metre);
    let mut apart = [TOUCHES_M * metre, APART_M * metre];
    // On a floor or rug.
    if support.half.z < PANEL * support.half.x.min(support.half.y) {
        let longest = 2.0 * thing.half.max_element();
        let legs = |at: usize| (LEGS[at] * longest).min(LEGS_M[at] * metre);
        apart = [apart[0].max(legs(0)), apart[1].max(legs(1))];
    }
    let touches = falling(gap, apart[0], apart[1]) * falling(sunk, 1.0, 1.5);
    touches.min(falling(-over, -OVER[0], -OVER[1]))
}

fn is_panel(half: DVec2) -> bool {
    half.min_element() < PANEL * half.max_element()
}

fn hanging(thing: &Solid, panel: &Solid, metre: f64) -> f64 {
    let (thick, wide) = (panel.half.x.min(panel.half.y), panel.half.x.max(panel.half.y));
    let is_panel =
        is_panel(panel.half.truncate()) && thing.volume() < panel.volume().max(wide * wide * thick);
    let is_off_the_ground = thing.bottom() > panel.bottom() + TOUCHES_M * metre;
    if !is_panel || !is_off_the_ground || thing.shared_height(panel) < 0.5 * thing.height() {
        return 0.0;
    }
    falling(thing.horizontal_gap(panel), TOUCHES_M * metre, APART_M * metre)
}

fn under(thing: &Solid, cover: &Solid, metre: f64) -> f64 {
    if thing.centre.z >= cover.centre.z || thing.top() > cover.top() {
        return 0.0;
    }
    let smaller = thing.area().min(cover.area()).max(f64::MIN_POSITIVE);
    // A picture hangs above a bed that stands before the wall.
    let hangs = is_panel(cover.half.truncate()) && cover.bottom() > thing.centre.z;
    let reach = if hangs { APART_M * metre } else { 0.0 };
    let share = thing.grown(reach).shared_area(cover) / smaller;
    // Under a table, not in the middle of a cupboard: it begins near the cover's bottom or below it.
    let raised = thing.bottom() - cover.bottom();
    let low = falling(raised, TOUCHES_M * metre, (APART_M * metre).max(0.3 * cover.height()));
    falling(-share, -OVER[0], -OVER[1]) * low
}

/// Distance of the surfaces, metres, up to which things are near.
const NEAR_M: f64 = 0.5;
/// Distance from which they are not; large things are near from farther away.
const FAR_M: f64 = 1.5;
/// Share of the smaller thing's size added to both.
const OF_SIZE: f64 = 0.5;
/// As [`NEAR_M`] and [`FAR_M`], for things beside each other.
const BESIDE_M: [f64; 2] = [0.6, 1.4];
/// Share of the lower thing's height that both must have in common.
const LEVEL: [f64; 2] = [0.5, 0.1];
/// Share of the smaller thing's outline that may lie over the other: boxes of close things overlap.
const APART: [f64; 2] = [0.5, 0.9];
/// Largest distance from the line between two things, as a share of its length, for a thing between them.
const OFF_LINE: [f64; 2] = [0.2, 0.5];

fn near(thing: &Solid, other: &Solid, metre: f64) -> f64 {
    let more = OF_SIZE * thing.half.max_element().min(other.half.max_element());
    falling(thing.gap(other), NEAR_M * metre + more, FAR_M * metre + more)
}

fn beside(thing: &Solid, other: &Solid, metre: f64) -> f64 {
    // A rug and a wardrobe stand on the same ground, though their boxes may share no height.
    let touches = TOUCHES_M * metre;
    let lower = thing.height().min(other.height()).max(touches);
    let level = falling(-(thing.shared_height(other) + touches) / lower, -LEVEL[0], -LEVEL[1]);
    let smaller = thing.area().min(other.area()).max(f64::MIN_POSITIVE);
    let apart = falling(thing.shared_area(other) / smaller, APART[0], APART[1]);
    let close = falling(thing.horizontal_gap(other), BESIDE_M[0] * metre, BESIDE_M[1] * metre);
    level.min(apart).min(close)
}

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

/// Metres by which a thing may stick out of its container's box.
const SLACK_M: f64 = 0.1;
/// Shares of a thing's box inside: the relation holds fully from the first, not at all up to the second.
const INSIDE: [f64; 2] = [0.8, 0.4];
/// A thing is smaller than this share of what it is in.
const SMALLER: f64 = 0.5;

fn inside(thing: &Solid, container: &Solid, metre: f64) -> f64 {
    if thing.volume() >= SMALLER * container.volume() {
        return 0.0;
    }
    let container = container.grown(SLACK_M * metre);
    let of_outline = thing.shared_area(&container) / thing.area().max(f64::MIN_POSITIVE);
    let of_height = thing.shared_height(&container).max(0.0) / thing.height().max(f64::MIN_POSITIVE);
    falling(-(of_outline * of_height).min(1.0), -INSIDE[0], -INSIDE[1])
}

/// Degrees off the direction: the relation holds fully up to the first, not at all from the second.
const OFF_DEG: [f64; 2] = [30.0, 60.0];
/// Distances of the outlines, metres: as [`OFF_DEG`]. A thing at the far end of a hall is not left of the door.
const REACH_M: [f64; 2] = [3.0, 7.0];

/// Returns the distances and angles up to which a relation holds, in words; empty where it has none of its own.
pub fn limits(is: Relation) -> &'static str {
    match is {
        Relation::Near => " (within about 1 m)",
        Relation::Beside => " (within 1 m, side by side)",
        Relation::LeftOf | Relation::RightOf | Relation::InFrontOf | Relation::Behind => {
            " (within 5 m and 45 degrees)"
        }
        _ => "",
    }
}

/// The asker's pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewer {
    pub position_in_world: DVec3,
    /// From the world's x axis towards y, radians.
    pub heading_rad: Option<f64>,
}

/// Returns the degree to which a thing is left of, right of, in front of or behind another, seen by the asker looking
/// at the latter; beside the asker itself, by its heading.
fn towards(is: Relation, thing: &Solid, of: &Solid, viewer: &Viewer, metre: f64) -> f64 {
    let anchor = of.centre.truncate();
    let sight = anchor - viewer.position_in_world.truncate();
    let heading = viewer.heading_rad.map(DVec2::from_angle);
    let is_asker = of.half == DVec3::ZERO && sight.length() <= f64::EPSILON;
    // In front of a thing is the asker's side; in front of the asker is its heading.
    let Some(away) = (if is_asker { heading.map(|ahead| -ahead) } else { sight.try_normalize() }) else {
        return 0.0;
    };
    let left = if is_asker { -away.perp() } else { away.perp() };
    let meant = match is {
        Relation::LeftOf => left,
        Relation::RightOf => -left,
        Relation::InFrontOf => -away,
        _ => away,
    };
    let offset = thing.centre.truncate() - anchor;
    // A thing that does not extend past the other's middle is in the same place.
    let past = offset.dot(meant) - 0.5 * of.reach(meant);
    if past <= 0.0 {
        return 0.0;
    }
    let angle = offset.angle_to(meant).abs().min(FRAC_PI_2).to_degrees();
    let gap = thing.horizontal_gap(of) / metre;
    falling(angle, OFF_DEG[0], OFF_DEG[1]).min(falling(gap, REACH_M[0], REACH_M[1]))
}

#[cfg(test)]
mod tests;
