use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use proptest::prelude::*;
use slag_common::frames::Aabb;

use super::*;
use crate::query::relations::grammar::RELATIONS;

const METRES: f64 = 1.0;

fn solid(centre: [f64; 3], size: [f64; 3]) -> Solid {
    Solid { centre: centre.into(), half: DVec3::from(size) * 0.5, along: DVec2::X }
}

fn turned(of: Solid, yaw_rad: f64, about: DVec2) -> Solid {
    let turn = DVec2::from_angle(yaw_rad);
    let at = turn.rotate(of.centre.truncate() - about) + about;
    Solid { centre: at.extend(of.centre.z), along: turn.rotate(of.along), ..of }
}

fn any_solid() -> impl Strategy<Value = Solid> {
    let (centre, size) = (prop::array::uniform3(-2.0f64..2.0), prop::array::uniform3(0.1f64..2.0));
    (centre, size, -4.0f64..4.0).prop_map(|(centre, size, yaw)| {
        let one = solid(centre, size);
        turned(one, yaw, one.centre.truncate())
    })
}

#[test]
fn a_room_by_hand() {
    let things = BTreeMap::from([
        ("table", solid([0.0, 0.0, 0.37], [1.6, 0.9, 0.74])),
        ("mug", solid([0.3, 0.1, 0.81], [0.1, 0.1, 0.14])),
        ("ball", solid([0.2, -0.1, 0.12], [0.24, 0.24, 0.24])),
        ("chair", solid([1.2, 0.0, 0.45], [0.5, 0.5, 0.9])),
        ("cushion", solid([1.2, 0.0, 0.5], [0.4, 0.4, 0.1])),
        ("wall", solid([0.0, 3.0, 1.3], [6.0, 0.05, 2.6])),
        ("clock", solid([0.5, 2.93, 1.8], [0.3, 0.06, 0.3])),
        ("rug", solid([0.0, 0.0, 0.01], [3.0, 2.0, 0.02])),
        ("cupboard", solid([-2.0, 2.5, 0.9], [1.0, 0.5, 1.8])),
        ("plate", solid([-2.0, 2.5, 1.0], [0.3, 0.3, 0.05])),
        // Its visible part begins above its feet.
        ("wardrobe", solid([2.1, 0.0, 1.0], [1.0, 0.6, 1.88])),
        ("lamp", solid([0.0, 0.0, 2.2], [0.4, 0.4, 0.3])),
        // Without their legs, which are thin: the chair's box begins 0.35 m above the floor, the desk's 0.4 m.
        ("floor", solid([0.0, 0.0, -0.05], [6.0, 6.0, 0.1])),
        ("seat", solid([-2.0, 0.0, 0.65], [0.5, 0.5, 0.6])),
        ("desk", solid([2.0, -2.0, 0.57], [1.2, 0.6, 0.34])),
        ("bed", solid([0.5, 1.8, 0.3], [1.6, 2.0, 0.5])),
    ]);
    // From the south, looking north.
    let viewer = Viewer { position_in_world: DVec3::new(0.0, -4.0, 0.0), heading_rad: Some(1.57) };
    let on = "mug table, cushion chair, clock wall, table rug, chair rug, seat floor, desk floor";
    let not_on =
        "table mug, ball table, lamp table, mug floor, cushion rug, lamp floor, chair table, cupboard wall";
    let not_under = "chair wall, mug table, plate cupboard, chair table";
    for (is, pairs, other_pairs) in [
        (Relation::On, on, not_on),
        (Relation::Under, "ball table, table lamp, bed clock", not_under),
        (Relation::Above, "clock bed, lamp table", ""),
        (Relation::In, "plate cupboard", "chair table, cupboard plate"),
        (Relation::Near, "mug table, chair table", "plate mug"),
        (Relation::Beside, "chair table, wardrobe rug", "mug table, clock table"),
        (Relation::LeftOf, "", "chair table"),
        (Relation::RightOf, "chair table", ""),
        (Relation::Behind, "wall table", "chair table"),
        (Relation::InFrontOf, "table wall", "wall table"),
    ] {
        for (pairs, holds) in [(pairs, true), (other_pairs, false)] {
            for (a, b) in pairs.split(", ").filter_map(|pair| pair.split_once(' ')) {
                let degree = degree(is, &things[a], &things[b], Some(&viewer), METRES);
                assert_eq!(degree >= HOLDS, holds, "{a} {is} {b}: {degree}");
            }
        }
    }
    let [left, right] = [[-2.0, 0.0, 0.5], [2.0, 0.3, 0.5]].map(|centre| solid(centre, [1.0; 3]));
    assert!(between(&things["table"], &left, &right) > HOLDS);
    assert!(between(&things["cupboard"], &things["table"], &things["chair"]) < HOLDS);
}

/// Beside the asker itself, its heading decides.
#[test]
fn the_asker_has_a_left_and_a_front() {
    let position_in_world = DVec3::new(1.0, 1.0, 0.0);
    let me = Solid::point(position_in_world);
    let viewer = Viewer { position_in_world, heading_rad: Some(std::f64::consts::FRAC_PI_2) };
    let at = |x: f64, y: f64| solid([1.0 + x, 1.0 + y, 0.3], [0.3; 3]);
    for (is, x, y) in [
        (Relation::LeftOf, -2.0, 0.0),
        (Relation::RightOf, 2.0, 0.0),
        (Relation::InFrontOf, 0.0, 2.0),
        (Relation::Behind, 0.0, -2.0),
    ] {
        for other in [Relation::LeftOf, Relation::RightOf, Relation::InFrontOf, Relation::Behind] {
            let degree = degree(other, &at(x, y), &me, Some(&viewer), METRES);
            assert_eq!(degree >= HOLDS, is == other, "{other} {x} {y}: {degree}");
        }
    }
    // By hand: 2 m less half of the thing, in any direction; the asker has no extent.
    for (x, y) in [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)] {
        assert!(
            (at(x, y).gap(&me) - 1.85).abs() < 0.01 && (me.gap(&at(x, y)) - 1.85).abs() < 0.01,
            "{x} {y}"
        );
        assert_eq!(degree(Relation::Near, &at(x, y), &me, Some(&viewer), METRES), 0.0);
    }
    assert_eq!(at(0.1, 0.1).gap(&me), 0.15, "above the asker");
    let blind = Viewer { heading_rad: None, ..viewer };
    assert_eq!(degree(Relation::LeftOf, &at(-2.0, 0.0), &me, Some(&blind), METRES), 0.0);
}

/// A thing is left of another up to 5 m away and 45 degrees off: four directions share no thing.
#[test]
fn directions_end_somewhere() {
    let viewer = Viewer { position_in_world: DVec3::new(0.0, -4.0, 0.0), heading_rad: None };
    let door = solid([0.0, 0.0, 1.0], [1.0, 0.1, 2.0]);
    let left = |x: f64, y: f64| {
        degree(Relation::LeftOf, &solid([x, y, 0.5], [0.2; 3]), &door, Some(&viewer), METRES)
    };
    assert_eq!(left(-2.0, 0.0), 1.0);
    assert!(left(-5.5, 0.0) > HOLDS && left(-5.7, 0.0) < HOLDS && left(-8.0, 0.0) == 0.0);
    assert!(left(-2.0, 1.9) > HOLDS && left(-2.0, 2.1) < HOLDS);
}

/// By hand, along the edges of the first, which is turned by a right angle.
#[test]
fn pieces_are_joined_along_the_first_ones_edges() {
    let first = turned(solid([0.0, 0.0, 0.5], [2.0, 1.0, 1.0]), std::f64::consts::FRAC_PI_2, DVec2::ZERO);
    let whole = first.joined(&solid([1.0, 0.0, 1.0], [1.0, 1.0, 1.0]));
    assert!((whole.centre - DVec3::new(0.5, 0.0, 0.75)).length() < 1e-12, "{whole:?}");
    assert!((whole.half - DVec3::new(1.0, 1.0, 0.75)).length() < 1e-12, "{whole:?}");
    assert!((whole.gap(&solid([3.0, 0.0, 0.5], [1.0, 1.0, 1.0])) - 1.0).abs() < 1e-12);
}

proptest! {
    /// Oracle: points on a lattice, one by one.
    #[test]
    fn outlines_share_what_a_lattice_says(a in any_solid(), b in any_solid()) {
        let inside = |of: &Solid, p: DVec2| {
            let offset = p - of.centre.truncate();
            offset.dot(of.along).abs() <= of.half.x && offset.dot(of.along.perp()).abs() <= of.half.y
        };
        let step = 0.02;
        let steps = || (0..).map(|i| -4.0 + step * (f64::from(i) + 0.5)).take_while(|v| *v < 4.0);
        let all = || steps().flat_map(|x| steps().map(move |y| DVec2::new(x, y)));
        let n_shared = all().filter(|p| inside(&a, *p) && inside(&b, *p)).count();
        let counted = n_shared as f64 * step * step;
        prop_assert!((a.shared_area(&b) - counted).abs() < 0.1, "{} {counted}", a.shared_area(&b));
        prop_assert!((a.shared_area(&b) - b.shared_area(&a)).abs() < 1e-9);
        // Points of each outline's border, all against all.
        let border = |of: &Solid| {
            let corners = of.corners();
            (0..4).flat_map(move |i| (0..=40).map(move |s| corners[i].lerp(corners[(i + 1) % 4], f64::from(s) / 40.0)))
        };
        let mut least = border(&a).flat_map(|p| border(&b).map(move |q| p.distance(q))).fold(f64::MAX, f64::min);
        if n_shared > 0 {
            least = 0.0;
        }
        prop_assert!((a.horizontal_gap(&b) - least).abs() < 0.08, "{} {least}", a.horizontal_gap(&b));
    }

    /// Degrees are numbers from 0 to 1 and do not depend on the world's axes.
    #[test]
    fn turning_the_world_changes_nothing(a in any_solid(), b in any_solid(), yaw in -4.0f64..4.0) {
        let viewer = Viewer { position_in_world: DVec3::new(5.0, 1.0, 0.0), heading_rad: Some(0.3) };
        let at = DVec2::from_angle(yaw).rotate(viewer.position_in_world.truncate());
        let other = Viewer { position_in_world: at.extend(0.0), heading_rad: Some(0.3 + yaw) };
        for (is, _) in RELATIONS {
            let one = degree(is, &a, &b, Some(&viewer), METRES);
            let turn = |of: &Solid| turned(*of, yaw, DVec2::ZERO);
            let two = degree(is, &turn(&a), &turn(&b), Some(&other), METRES);
            prop_assert!((0.0..=1.0).contains(&one) && (one - two).abs() < 1e-6, "{is} {one} {two}");
        }
    }
}

#[test]
fn flat_and_empty_boxes_have_degrees_too() {
    let flat = solid([0.0; 3], [1.0, 0.0, 0.0]);
    let nothing = Solid::of_aabb(&Aabb { min: DVec3::ZERO, max: DVec3::ZERO });
    let viewer = Viewer { position_in_world: DVec3::ZERO, heading_rad: None };
    for (is, _) in RELATIONS {
        for (a, b) in [(&flat, &nothing), (&nothing, &flat), (&nothing, &nothing)] {
            let degree = degree(is, a, b, Some(&viewer), METRES);
            assert!((0.0..=1.0).contains(&degree), "{is}: {degree}");
        }
    }
    assert_eq!(between(&flat, &nothing, &nothing), 0.0);
}
