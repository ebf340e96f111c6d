//! On, under and above: one thing over another.

use super::measure::falling;
use super::solid::Solid;

/// Distance, in metres, between a thing's bottom and the surface below it that still counts as touching: positions
/// are those of Gaussians, and the box leaves out the outermost ones.
const TOUCHES_M: f64 = 0.1;
/// Distance at which it surely does not touch.
const APART_M: f64 = 0.25;
/// Share of the support's height by which a thing's bottom may lie below its top: seats are lower than backs, and
/// the masks of a support may take in what stands on it.
const SUNK: f64 = 0.6;
/// Share of a thing's outline that must lie over its support.
const OVER: [f64; 2] = [0.6, 0.2];
/// A panel, such as a wall, is thinner than this share of its width.
const PANEL: f64 = 0.25;

/// Returns the degree to which a thing rests on another, or hangs on it if that is a panel.
pub fn on(thing: &Solid, support: &Solid, metre: f64) -> f64 {
    resting(thing, support, metre).max(hanging(thing, support, metre))
}

fn resting(thing: &Solid, support: &Solid, metre: f64) -> f64 {
    // A thing that is much larger than its support rests on something else.
    if thing.area() > 2.0 * support.area() || thing.centre.z <= support.centre.z {
        return 0.0;
    }
    let over = thing.shared_area(support) / thing.area().max(f64::MIN_POSITIVE);
    let gap = thing.bottom() - support.top();
    let sunk = -gap / (SUNK * support.height()).max(TOUCHES_M * metre);
    let touches = falling(gap, TOUCHES_M * metre, APART_M * metre) * falling(sunk, 1.0, 1.5);
    touches * falling(-over, -OVER[0], -OVER[1])
}

fn hanging(thing: &Solid, panel: &Solid, metre: f64) -> f64 {
    let (thick, wide) = (panel.half.x.min(panel.half.y), panel.half.x.max(panel.half.y));
    let is_panel = thick < PANEL * wide && thing.volume() < panel.volume().max(wide * wide * thick);
    let is_off_the_ground = thing.bottom() > panel.bottom() + TOUCHES_M * metre;
    if !is_panel || !is_off_the_ground || thing.shared_height(panel) < 0.5 * thing.height() {
        return 0.0;
    }
    falling(thing.horizontal_gap(panel), TOUCHES_M * metre, APART_M * metre)
}

/// Returns the degree to which a thing is below another and within its outline.
pub fn under(thing: &Solid, cover: &Solid, metre: f64) -> f64 {
    if thing.centre.z >= cover.centre.z || thing.top() > cover.top() {
        return 0.0;
    }
    let smaller = thing.area().min(cover.area()).max(f64::MIN_POSITIVE);
    let share = thing.shared_area(cover) / smaller;
    // Under a table, not in the middle of a cupboard: it begins near the cover's bottom or below it.
    let raised = thing.bottom() - cover.bottom();
    let low = falling(raised, TOUCHES_M * metre, (APART_M * metre).max(0.3 * cover.height()));
    falling(-share, -OVER[0], -OVER[1]) * low
}
