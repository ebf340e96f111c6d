//! Left, right, in front and behind, as the asker sees them.

use std::f64::consts::FRAC_PI_2;

use glam::{DVec2, DVec3};

use super::measure::falling;
use super::solid::Solid;
use crate::query::relations::phrase::Relation;

/// Angles from the direction that is meant, in degrees: the relation holds fully up to the first, not at all from
/// the second.
const OFF_DEG: [f64; 2] = [30.0, 70.0];
/// Distances of the outlines, in metres, from which the degree falls, and at which half of it is left: a thing at
/// the far end of a hall is no answer to "left of the door" if there is another beside it.
const REACH_M: [f64; 2] = [3.0, 12.0];

/// Where the asker is, and where it looks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Viewer {
    pub position_in_world: DVec3,
    /// Its heading, from the world's x axis towards y, radians.
    pub heading_rad: Option<f64>,
}

/// Returns the degree to which a thing is left of another, right of it, in front of it or behind it.
///
/// Seen from the asker, who looks at the other thing; beside the asker itself, from its heading.
pub fn towards(is: Relation, thing: &Solid, of: &Solid, viewer: &Viewer, metre: f64) -> f64 {
    let anchor = of.centre.truncate();
    let sight = anchor - viewer.position_in_world.truncate();
    let heading = viewer.heading_rad.map(DVec2::from_angle);
    let is_asker = of.half == DVec3::ZERO && sight.length() <= f64::EPSILON;
    // What is in front of a thing is on the asker's side of it; what is in front of the asker is where it looks.
    let Some(away) = (if is_asker { heading.map(|ahead| -ahead) } else { sight.try_normalize() }) else {
        return 0.0;
    };
    let meant = match is {
        Relation::LeftOf => {
            if is_asker {
                -away.perp()
            } else {
                away.perp()
            }
        }
        Relation::RightOf => {
            if is_asker {
                away.perp()
            } else {
                -away.perp()
            }
        }
        Relation::InFrontOf => -away,
        _ => away,
    };
    let offset = thing.centre.truncate() - anchor;
    // A thing that does not reach past the other's middle is in the same place.
    let past = offset.dot(meant) - 0.5 * of.reach(meant);
    if past <= 0.0 {
        return 0.0;
    }
    let angle = offset.angle_to(meant).abs().min(FRAC_PI_2).to_degrees();
    let gap = thing.horizontal_gap(of) / metre;
    let reach = 1.0 - 0.5 * (1.0 - falling(gap, REACH_M[0], REACH_M[1]));
    falling(angle, OFF_DEG[0], OFF_DEG[1]) * reach
}
