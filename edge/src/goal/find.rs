//! From a request to poses.

use glam::DVec3;
use slag_api::goal::{GoalMiss, GoalReply, MissedThing, NoGoal, TargetThing};
use slag_common::objects::{parse_public_id, public_id};

use super::choose::choose;
use super::request::{GoalRequest, GoalTarget, Robot, Stand};
use super::surroundings::{START_M, Surroundings, no_places};
use crate::query::{ClusterAnswer, Found, OnBoard, QueryError, QueryRequest, Scene};
use crate::score::{Budget, Region};

const MAX_THINGS: usize = 5;
const MAX_POINTS: usize = 4096;

/// Finds places to stand near a thing. Blocks for tens of milliseconds.
///
/// # Errors
/// [`QueryError`]. That there is no such place is a reply.
pub fn find(on_board: &OnBoard, request: &GoalRequest, budget: &Budget) -> Result<GoalReply, QueryError> {
    request.check()?;
    let snapshot = &on_board.snapshot;
    let manifest = &snapshot.manifest;
    let near = request.near.unwrap_or(snapshot.current.centre_in_world);
    let things = match things(on_board, request, near, budget)? {
        Ok(things) => things,
        Err(detail) => {
            let mut reply = GoalReply::empty(&manifest.scene, manifest.generation, 0.0, near);
            reply.none = Some(GoalMiss { kind: NoGoal::NoSuchThing, detail });
            return Ok(reply);
        }
    };
    let seen = Surroundings::look(snapshot, request, near, budget)?;
    let voxel = seen.space.window.voxel;
    let mut reply = GoalReply::empty(&manifest.scene, manifest.generation, voxel, near);
    let Some(start) = seen.start(near, request.robot.radius_m) else {
        let detail = format!(
            "within {START_M} m of [{:.2}, {:.2}, {:.2}], where the robot is taken to be, no known ground at that height has {} m \
             free around it and {:.1} m above; give a place on the ground as near (--near X,Y,Z), or a smaller robot",
            near.x,
            near.y,
            near.z,
            request.robot.radius_m,
            request.robot.height()
        );
        reply.none = Some(GoalMiss { kind: NoGoal::UnknownGround, detail });
        return Ok(reply);
    };
    let (paths, scene) = (seen.paths_from(start), Scene::of(snapshot));
    for (shape, thing) in things {
        let points = match shape {
            Shape::Object(id) => scene.object_points(id, MAX_POINTS, budget),
            Shape::Group(group) => scene.answer_points(&group, MAX_POINTS, budget),
        };
        budget.check()?;
        let chosen = choose(&seen, &paths, request, &points);
        // Looks end early once the budget is spent.
        budget.check()?;
        match chosen {
            Ok(mut goals) => {
                for goal in &mut goals {
                    goal.geographic =
                        manifest.geo_reference.map(|geo| geo.geographic_from_world(goal.position_in_world));
                }
                return Ok(GoalReply { thing: Some(thing), goals, ..reply });
            }
            Err(none) => reply.missed.push(MissedThing { thing, none }),
        }
    }
    reply.none = reply
        .missed
        .first()
        .map(|missed| GoalMiss { kind: missed.none, detail: detail(missed, request, voxel) });
    Ok(reply)
}

fn detail(missed: &MissedThing, request: &GoalRequest, voxel: f64) -> String {
    let step_m = request.robot.step_m(voxel);
    let MissedThing { thing: TargetThing { id, .. }, none } = missed;
    let Robot { radius_m, range_m, sensor_height_m, slope, .. } = request.robot;
    let Stand { reach_m, min_visible, .. } = request.stand;
    match none {
        NoGoal::NoSuchThing => format!("{id} is not on board"),
        NoGoal::Unreachable => format!(
            "no way within {range_m} m leads a robot of {radius_m} m radius, up steps of {step_m} m and slopes of {slope}, to within \
             {reach_m} m of {id}; a larger step_m, slope, range_m or reach_m may, or a smaller radius_m"
        ),
        NoGoal::UnknownGround => format!(
            "most ground within {reach_m} m of {id} is not known, or farther than {range_m} m from the robot"
        ),
        NoGoal::NotVisible => format!(
            "no place within {reach_m} m shows {:.0} % of {id} to a sensor {sensor_height_m} m above the ground",
            100.0 * min_visible
        ),
    }
}

/// What a thing's surface is taken from.
enum Shape {
    Object(u64),
    /// Gaussians that match a text, where no object does.
    Group(Box<ClusterAnswer>),
}

type Things = Vec<(Shape, TargetThing)>;

/// Returns the things to go to, best first, or why there is none.
fn things(
    on_board: &OnBoard,
    request: &GoalRequest,
    near: DVec3,
    budget: &Budget,
) -> Result<Result<Things, String>, QueryError> {
    let text = match &request.target {
        GoalTarget::Object(id) => {
            if on_board.snapshot.objects.is_empty() {
                let detail = "the scene has no objects to go to; encode it without --no-objects, publish it, and fetch it again";
                return Err(no_places("no-objects", detail));
            }
            let scene = Scene::of(&on_board.snapshot);
            let found = scene.object(*id, None, budget);
            budget.check()?;
            let Some(object) = found else {
                let missing = scene.coverage(&Region::default()).missing();
                let missing = missing.map(|missing| format!("; {missing}")).unwrap_or_default();
                let (generation, id) = (scene.manifest.generation, public_id(*id));
                return Ok(Err(format!("generation {generation} has no object {id} on board{missing}")));
            };
            let thing =
                TargetThing { id: object.id, position_in_world: object.position_in_world, score: None };
            return Ok(Ok(vec![(Shape::Object(*id), thing)]));
        }
        GoalTarget::Text(text) => text,
    };
    let request = QueryRequest {
        near: Some(near),
        heading_rad: request.heading_rad,
        limit: Some(MAX_THINGS),
        members: true,
        ..QueryRequest::new(text)
    };
    let found = on_board.answer(request, budget)?.answers.remove(0);
    let none = found.reason.map(|reason| reason.detail);
    let Found::Clusters(answers) = found.answers else { return Ok(Ok(Vec::new())) };
    if answers.is_empty() {
        return Ok(Err(none.unwrap_or_else(|| "nothing on board matches".to_owned())));
    }
    let thing = |answer: ClusterAnswer| {
        let thing = TargetThing {
            id: answer.id.clone(),
            position_in_world: answer.position_in_world,
            score: Some(answer.score),
        };
        let shape = parse_public_id(&answer.id).map_or_else(|| Shape::Group(Box::new(answer)), Shape::Object);
        (shape, thing)
    };
    Ok(Ok(answers.into_iter().map(thing).collect()))
}
