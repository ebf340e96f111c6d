use std::time::Duration;

use glam::DVec3;
use slag_api::goal::{Goal, NoGoal};
use slag_common::occupancy::{Block, BuiltOccupancy};

use super::choose::choose;
use super::surroundings::Surroundings;
use super::*;
use crate::score::{Budget, Pool};

const VOXEL: f64 = 0.05;

/// State of a made world at a point.
#[derive(Clone, Copy, PartialEq)]
enum At {
    Free,
    Solid,
    Unseen,
}

/// Packs a world of 6 by 6 by 1.6 m by the states at voxel centres.
fn packed(world: impl Fn(DVec3) -> At) -> BuiltOccupancy {
    packed_in(VOXEL, -0.4, world)
}

/// Packs it with another voxel size, from a lower corner on.
fn packed_in(voxel_m: f64, low: f64, world: impl Fn(DVec3) -> At) -> BuiltOccupancy {
    let mut blocks = Vec::new();
    let block = |metres: f64| (metres / (4.0 * voxel_m)).round() as i32;
    let (sides, heights) = (block(-0.4)..block(6.4), block(low)..block(1.6));
    let columns = sides.clone().flat_map(|x| sides.clone().map(move |y| [x, y]));
    for at in columns.flat_map(|[x, y]| heights.clone().map(move |z| [x, y, z])) {
        let mut block = Block { at, occupied: 0, free: 0 };
        for bit in 0..64i32 {
            let voxel = [4 * at[0] + bit / 16, 4 * at[1] + bit / 4 % 4, 4 * at[2] + bit % 4];
            match world((DVec3::from(voxel.map(f64::from)) + 0.5) * voxel_m) {
                At::Free => block.free |= 1 << bit,
                At::Solid => block.occupied |= 1 << bit,
                At::Unseen => {}
            }
        }
        blocks.push(block);
    }
    BuiltOccupancy::pack(voxel_m, 0.1, 2, &blocks)
}

fn inside(point: DVec3, low: [f64; 3], high: [f64; 3]) -> bool {
    point.cmpge(low.into()).all() && point.cmplt(high.into()).all()
}

/// A hall of 6 by 6 m with a floor at z = 0 and a box of 0.4 m at its middle, plus `more`.
fn hall(more: impl Fn(DVec3) -> Option<At>) -> impl Fn(DVec3) -> At {
    move |p| match () {
        () if !inside(p, [0.0, 0.0, -0.1], [6.0, 6.0, 1.5]) => At::Unseen,
        () if p.z < 0.0 || inside(p, [2.8, 2.8, 0.0], [3.2, 3.2, 0.4]) => At::Solid,
        () => more(p).unwrap_or(At::Free),
    }
}

fn points() -> Vec<DVec3> {
    let steps = [2.8, 2.9, 3.0, 3.1, 3.2];
    let all = steps
        .into_iter()
        .flat_map(|x| steps.into_iter().flat_map(move |y| [0.1, 0.2, 0.3, 0.4].map(|z| DVec3::new(x, y, z))));
    all.filter(|p| p.x == 2.8 || p.x == 3.2 || p.y == 2.8 || p.y == 3.2 || p.z == 0.4).collect()
}

const START: DVec3 = DVec3::new(0.6, 3.0, 0.0);

fn asked(change: impl FnOnce(&mut GoalRequest)) -> GoalRequest {
    let mut request = GoalRequest::new(GoalTarget::Object(1));
    change(&mut request);
    request
}

type Goals = Result<Vec<Goal>, NoGoal>;

fn stand(world: &BuiltOccupancy, request: &GoalRequest, near: DVec3, points: &[DVec3]) -> Goals {
    let (request, budget) = (&GoalRequest { near: Some(near), ..request.clone() }, Budget::default());
    let seen = Surroundings::of(&[world.view()], request, near, &budget).expect("places are known");
    let start = seen.start(near, request.robot.radius_m).ok_or(NoGoal::UnknownGround)?;
    choose(&seen, &seen.paths_from(start), request, points)
}

fn goals_with(world: &BuiltOccupancy, request: &GoalRequest) -> Goals {
    stand(world, request, START, &points())
}

fn goals(more: impl Fn(DVec3) -> Option<At>) -> Goals {
    goals_with(&packed(hall(more)), &asked(|r| r.stand.limit = 5))
}

/// Distances, clearances and headings by the hall's geometry.
#[test]
fn poses_are_in_reach_clear_and_turned_to_the_thing() {
    let found = goals(|_| None).expect("poses");
    assert!(found.len() > 1);
    for goal in &found {
        let Goal { position_in_world: at, distance_m, clearance_m, path_m, .. } = *goal;
        let outside = |v: f64| (2.8 - v).max(v - 3.2).max(0.0);
        let true_distance = outside(at.x).hypot(outside(at.y));
        assert!(true_distance <= 0.8 && (true_distance - distance_m).abs() < 0.06, "{goal:?}");
        // Cells are obstacles by their centres, up to half a voxel behind the surface.
        assert!(clearance_m >= 0.3 && (clearance_m - true_distance).abs() < 0.06, "{goal:?}");
        assert!(at.z.abs() < 0.1, "{goal:?}");
        let line = at.distance(START);
        assert!(path_m > line - 0.1 && path_m < 1.09 * line + 0.1, "{goal:?}");
        // The near sides and the top are seen, the far sides are not.
        assert!(goal.visible_share > 0.3 && goal.visible_share < 0.85, "{goal:?}");
        let heading = DVec3::new(goal.yaw_rad.cos(), goal.yaw_rad.sin(), 0.0);
        let towards = (DVec3::new(3.0, 3.0, 0.0) - at).with_z(0.0).normalize();
        assert!(heading.dot(towards) > 0.9, "{goal:?}");
        let [x, y, z, w] = goal.orientation_xyzw;
        let turned = glam::DQuat::from_xyzw(x, y, z, w) * DVec3::X;
        assert!((turned - heading).length() < 1e-9, "{goal:?}");
    }
    assert!(found[0].position_in_world.x < 2.8, "{:?}", found[0]);
    let apart = |a: &Goal, b: &Goal| a.position_in_world.distance(b.position_in_world) >= 0.5;
    assert!((1..found.len()).all(|i| (0..i).all(|j| apart(&found[i], &found[j]))));
}

#[test]
fn what_is_walled_off_is_unreachable() {
    let wall = |p: DVec3| inside(p, [1.5, 0.0, 0.0], [1.6, 6.0, 1.5]).then_some(At::Solid);
    assert_eq!(goals(wall), Err(NoGoal::Unreachable));
    // With a door of 0.8 m it is reached, with one of 0.5 m it is not.
    let door = |half: f64| move |p: DVec3| wall(p).filter(|_| (p.y - 5.0).abs() > half);
    let found = goals(door(0.4)).expect("poses");
    assert!(found[0].path_m > START.distance(DVec3::new(1.5, 5.0, 0.0)), "through the door: {:?}", found[0]);
    assert_eq!(goals(door(0.25)), Err(NoGoal::Unreachable));
}

#[test]
fn unknown_is_never_free() {
    // An unseen strip of ground across the hall.
    let strip = |p: DVec3| inside(p, [1.5, 0.0, -0.1], [2.0, 6.0, 1.5]).then_some(At::Unseen);
    assert_eq!(goals(strip), Err(NoGoal::Unreachable));
    // Seen ground below unseen air.
    let air = |p: DVec3| inside(p, [1.5, 0.0, 0.3], [2.0, 6.0, 1.5]).then_some(At::Unseen);
    assert_eq!(goals(air), Err(NoGoal::Unreachable));
    let around_thing = |p: DVec3| inside(p, [1.5, 1.5, -0.1], [4.5, 4.5, 1.5]).then_some(At::Unseen);
    assert_eq!(goals(around_thing), Err(NoGoal::UnknownGround));
    let at_robot = |p: DVec3| inside(p, [0.0, 1.5, -0.1], [2.0, 4.5, 1.5]).then_some(At::Unseen);
    assert_eq!(goals(at_robot), Err(NoGoal::UnknownGround));
    // Unseen air between the robot's places and the thing hides it.
    let ring = |p: DVec3| {
        let d = (p.x - 3.0).abs().max((p.y - 3.0).abs());
        (p.z > 0.05 && d > 0.3 && d < 0.45).then_some(At::Unseen)
    };
    assert_eq!(goals(ring), Err(NoGoal::NotVisible));
}

#[test]
fn a_screen_hides_the_thing_from_low_sensors() {
    let screen = |p: DVec3| {
        let d = (p.x - 3.0).abs().max((p.y - 3.0).abs());
        (p.z < 0.6 && d > 0.35 && d < 0.4).then_some(At::Solid)
    };
    let world = packed(hall(screen));
    let request = |sensor_height_m| asked(|r| r.robot.sensor_height_m = sensor_height_m);
    assert_eq!(goals_with(&world, &request(0.4)), Err(NoGoal::NotVisible));
    goals_with(&world, &request(1.3)).expect("over the screen it is seen");
}

/// A board across the whole path with a thing on it: the robot drives below and does not see through the board.
#[test]
fn nothing_is_seen_through_what_a_thing_stands_on() {
    let board = |p: DVec3| inside(p, [1.4, 1.4, 0.65], [4.6, 4.6, 0.7]).then_some(At::Solid);
    let no_box = |p: DVec3| match hall(board)(p) {
        At::Solid if p.z > 0.0 && board(p).is_none() => At::Free,
        at => at,
    };
    let world = packed(no_box);
    let on_board: Vec<DVec3> = points().into_iter().map(|p| p + DVec3::Z * 0.6).collect();
    let request = asked(|_| {});
    assert_eq!(stand(&world, &request, START, &on_board), Err(NoGoal::NotVisible));
    // A thing that hangs there is seen from below.
    let empty = packed(|p: DVec3| match no_box(p) {
        At::Solid if p.z > 0.0 => At::Free,
        at => at,
    });
    stand(&empty, &request, START, &on_board).expect("poses");
}

/// A plate on a wall, from below: the line to it passes through voxels shared by wall and plate for longer
/// than two edges. A bump of the wall below hides it.
#[test]
fn what_hangs_on_a_wall_is_seen_from_below() {
    let wall = |p: DVec3| (p.x > 4.9 && p.x < 5.1).then_some(At::Solid);
    let on_wall: Vec<DVec3> = (0..9)
        .flat_map(|y| {
            (0..9).map(move |z| DVec3::new(4.98, 2.8 + 0.05 * f64::from(y), 1.0 + 0.05 * f64::from(z)))
        })
        .collect();
    let request = asked(|r| r.stand.reach_m = 0.45);
    let world = packed(hall(wall));
    let found = stand(&world, &request, START, &on_wall).expect("poses");
    // Lines to its lower part enter the wall below it.
    assert!(found[0].visible_share > 0.3, "{found:?}");
    let bump =
        |p: DVec3| wall(p).or_else(|| inside(p, [4.7, 2.0, 0.75], [4.9, 4.0, 0.85]).then_some(At::Solid));
    let world = packed(hall(bump));
    assert_eq!(stand(&world, &request, START, &on_wall), Err(NoGoal::NotVisible));
}

/// A pole behind a screen with a slit of one voxel is seen from a strip of 10 cm; the cheapest place of its
/// square is off the strip, as the robot comes from beside it.
#[test]
fn a_narrow_strip_from_which_a_thing_is_seen_is_found() {
    let screen = |slit: bool| {
        move |p: DVec3| {
            let d = (p.x - 3.0).abs().max((p.y - 3.0).abs());
            let is_slit = slit && p.x < 2.7 && inside(p, [2.0, 3.1, 0.0], [2.7, 3.15, 1.5]);
            match () {
                () if d < 0.35 && p.z > 0.0 => Some(At::Free),
                () => (d > 0.35 && d < 0.4 && !is_slit).then_some(At::Solid),
            }
        }
    };
    let pole: Vec<DVec3> = (2..16).map(|k| DVec3::new(3.0, 3.125, 0.05 * f64::from(k))).collect();
    let world = |slit| {
        let with_screen = screen(slit);
        packed(move |p: DVec3| match hall(|_| None)(p) {
            At::Unseen => At::Unseen,
            at => with_screen(p).unwrap_or(at),
        })
    };
    let found = |slit| {
        let request = asked(|_| {});
        stand(&world(slit), &request, DVec3::new(0.6, 0.6, 0.0), &pole)
    };
    let seeing = found(true).expect("poses");
    assert!(seeing.iter().all(|goal| (goal.position_in_world.y - 3.125).abs() < 0.1), "{seeing:?}");
    assert_eq!(found(false), Err(NoGoal::NotVisible));
}

#[test]
fn steps_and_slopes_count() {
    let ramp = |rise: f64| {
        move |p: DVec3| {
            let height = ((p.x - 1.2) * rise).clamp(0.0, 0.3);
            (p.x < 2.5 && p.z < height)
                .then_some(At::Solid)
                .or_else(|| (p.z < 0.3 && p.x >= 2.5 && p.x < 2.6).then_some(At::Solid))
        }
    };
    // Up a ramp, to a drop of 0.3 m at 2.6 m: no path leads closer than its upper side, 0.5 m from the box.
    let world = packed(hall(ramp(0.3)));
    let within = |reach_m| asked(|r| r.stand.reach_m = reach_m);
    let found = goals_with(&world, &within(0.8)).expect("poses");
    assert!(found.iter().all(|goal| goal.position_in_world.x <= 2.31), "{found:?}");
    assert_eq!(goals_with(&world, &within(0.45)), Err(NoGoal::Unreachable));
    // A threshold of 5 cm is climbed, one of 15 cm is not.
    let threshold =
        |height: f64| move |p: DVec3| (inside(p, [1.5, 0.0, 0.0], [2.0, 6.0, height])).then_some(At::Solid);
    goals(threshold(0.05)).expect("poses");
    assert_eq!(goals(threshold(0.15)), Err(NoGoal::Unreachable));
    let world = packed(hall(threshold(0.15)));
    goals_with(&world, &asked(|r| r.robot.step_m = Some(0.2))).expect("a robot that climbs 20 cm");
    // A slope with a ramp on both sides.
    let hill = |p: DVec3| (p.z < (0.5 - (p.x - 1.8).abs()).max(0.0) * 0.6).then_some(At::Solid);
    goals(hill).expect("over the hill");
}

#[test]
fn tables_are_driven_under_or_around() {
    // A table of 0.7 m across the whole path: a low robot drives below, a high one cannot.
    let table = |p: DVec3| inside(p, [1.4, 0.0, 0.65], [2.0, 6.0, 0.7]).then_some(At::Solid);
    let world = packed(hall(table));
    goals_with(&world, &asked(|_| {})).expect("below the table");
    assert_eq!(goals_with(&world, &asked(|r| r.robot.height_m = Some(0.9))), Err(NoGoal::Unreachable));
}

/// The robot's position is a little inside a coffee table, by its edge: the top is ground with room above and
/// nearer than the floor, but the given height is the floor's.
#[test]
fn the_robots_height_decides_where_it_stands() {
    let table = |p: DVec3| inside(p, [1.0, 2.4, 0.0], [1.9, 3.6, 0.35]).then_some(At::Solid);
    let world = packed(hall(table));
    let request = asked(|_| {});
    let poses = |z: f64| stand(&world, &request, DVec3::new(1.1, 3.0, z), &points());
    for goal in poses(0.0).expect("from the floor beside it") {
        assert!(goal.position_in_world.z.abs() < 0.1, "{goal:?}");
    }
    assert_eq!(poses(0.35), Err(NoGoal::Unreachable), "no way leads off the table");
    let above = stand(&world, &request, START.with_z(2.0), &points());
    assert_eq!(above, Err(NoGoal::UnknownGround), "a floor so far below is that of another storey");
    let deep = stand(&world, &request, DVec3::new(1.45, 3.0, 0.0), &points());
    assert_eq!(deep, Err(NoGoal::UnknownGround), "no floor is near enough");
}

/// A storey 2.8 m below, with cupboards and tables within the window.
#[test]
fn the_storey_below_is_not_the_ground() {
    let upper = hall(|_| None);
    let below = |p: DVec3| match () {
        () if p.z < -2.9 || !inside(p, [0.0, 0.0, -9.0], [6.0, 6.0, 9.0]) => At::Unseen,
        () if p.z < -2.8 || p.z > -0.3 => At::Solid,
        () if inside(p, [1.5, 0.0, -2.8], [2.2, 6.0, -1.6]) => At::Solid,
        () if inside(p, [2.4, 2.4, -2.8], [3.6, 3.6, -2.1]) => At::Solid,
        () => At::Free,
    };
    let world = packed_in(VOXEL, -3.2, |p| if p.z < -0.1 { below(p) } else { upper(p) });
    let request = asked(|r| r.stand.limit = 5);
    let found = stand(&world, &request, START, &points()).expect("poses");
    assert_eq!(found, goals(|_| None).expect("poses"), "as without a storey below");
    // From below, the cupboard is in the way; the thing itself is upstairs.
    let found = stand(&world, &request, START.with_z(-2.8), &points());
    assert!(found.is_err(), "{found:?}");
}

#[test]
fn steep_ramps_are_not_driven() {
    // A ridge across the hall, by its slope.
    let ridge = |slope: f64| {
        move |p: DVec3| (p.z < (0.9 - (p.x - 1.8).abs() * 1.0).max(0.0) * slope).then_some(At::Solid)
    };
    goals(ridge(0.3)).expect("over a gentle one");
    assert_eq!(goals(ridge(0.95)), Err(NoGoal::Unreachable), "43 degrees");
    let world = packed(hall(ridge(0.95)));
    goals_with(&world, &asked(|r| r.robot.slope = 1.2)).expect("a robot that climbs");
}

/// A step too small to show in the voxels is refused.
#[test]
fn steps_below_the_voxels_are_refused() {
    let refused = |voxel: f64, step_m: Option<f64>| {
        let world = packed_in(voxel, -4.0 * voxel, hall(|_| None));
        let request = asked(|r| r.robot.step_m = step_m);
        let budget = Budget::default();
        let seen = Surroundings::of(&[world.view()], &request, START, &budget);
        seen.err().map(|error| error.to_string())
    };
    for (voxel, step_m) in [(0.05, 0.0), (0.05, 0.05), (0.05, 0.07), (0.1, 0.1), (0.5, 0.0), (0.5, 0.5)] {
        let error = refused(voxel, Some(step_m)).expect("refused");
        assert!(error.contains("step_m") && error.contains("at least"), "{voxel} {step_m}: {error}");
    }
    for (voxel, step_m) in [(0.05, 0.075), (0.05, 0.1), (0.1, 0.15)] {
        assert_eq!(refused(voxel, Some(step_m)), None, "{voxel} {step_m}");
    }
    // The default fits voxels up to 10 cm.
    assert_eq!([0.02, 0.05, 0.1].map(|voxel| refused(voxel, None)), [None, None, None]);
    assert!(refused(0.2, None).is_some());
    // In voxels of 10 cm the same hall has poses.
    let world = packed_in(0.1, -0.4, hall(|_| None));
    goals_with(&world, &asked(|r| r.robot.step_m = Some(0.15))).expect("poses");
}

#[test]
fn places_are_looked_at_within_a_budget() {
    let world = packed(hall(|_| None));
    let request = GoalRequest { near: Some(START), ..asked(|_| {}) };
    let pool = Pool::new(u64::MAX);
    let look = |bytes: u64, time: Duration| {
        let budget = Budget::new(bytes, time, &pool);
        Surroundings::of(&[world.view()], &request, START, &budget).err().map(|error| error.kind())
    };
    let hour = Duration::from_secs(3600);
    assert_eq!([look(1 << 20, hour), look(1 << 28, Duration::ZERO)], [Some("over-budget"); 2]);
    assert_eq!((look(1 << 28, hour), pool.used_bytes()), (None, 0));
}

#[test]
fn requests_out_of_range_name_the_parameter() {
    let refused = |change: &dyn Fn(&mut GoalRequest)| {
        asked(|_| {}).check().expect("the default is valid");
        asked(change).check().expect_err("refused").parameter
    };
    assert_eq!(refused(&|r| r.robot.radius_m = 0.0), "radius_m");
    assert_eq!(refused(&|r| r.stand.reach_m = f64::NAN), "reach_m");
    assert_eq!(refused(&|r| r.robot.height_m = Some(0.2)), "height_m");
    assert_eq!(refused(&|r| r.robot.sensor_height_m = 2.4), "sensor_height_m");
    assert_eq!(refused(&|r| r.robot.step_m = Some(-0.1)), "step_m");
    assert_eq!(refused(&|r| r.robot.slope = 0.0), "slope");
    assert_eq!(refused(&|r| r.robot.range_m = 51.0), "range_m");
    assert_eq!(refused(&|r| r.stand.min_visible = 0.0), "min_visible");
    assert_eq!(refused(&|r| r.stand.limit = 0), "limit");
    assert_eq!(refused(&|r| r.near = Some(DVec3::splat(f64::INFINITY))), "near");
}
