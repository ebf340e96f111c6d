//! Request and reply of `where_to_stand`.

use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use slag_robot::api::goal::{Goal, GoalMiss, GoalReply, NoGoal, TargetThing};
use slag_robot::{parse_public_id, xyz};

/// A thing to go to, and the robot that goes.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Going {
    /// A thing in a few words, as for `find`, or the id of a thing on board.
    #[schemars(length(min = 1, max = 512))]
    pub what: String,
    /// Where the robot is, [x, y, z] in the world frame. Absent: where the robot itself says it is.
    pub near: Option<[f64; 3]>,
    /// Where it looks, radians from the world's x axis towards y. For "left of me" and the like.
    pub heading_rad: Option<f64>,
    /// Radius of the robot, metres, seen from above; 0.3 if absent.
    #[schemars(range(min = 0.05, max = 2.0))]
    pub radius_m: Option<f64>,
    /// How close its middle must come to the thing's surface, metres; 0.8 if absent.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub reach_m: Option<f64>,
    /// Height of its camera above the ground, metres; 0.4 if absent.
    #[schemars(range(min = 0.05, max = 2.3))]
    pub sensor_height_m: Option<f64>,
}

/// Places to stand, best first.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Stands {
    /// Name of the scene.
    pub scene: String,
    /// The state of the map; positions of different generations are not comparable.
    pub generation: u64,
    /// The thing; its id and its middle in the world frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub thing: Option<Target>,
    /// Best first. Empty: see `none`.
    pub places: Vec<Stand>,
    /// Why there is none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub none: Option<GoalMiss>,
    /// Things that match better than `thing` and have no place to stand, best first.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(default)]
    pub passed_over: Vec<PassedOver>,
}

/// A thing without a place to stand.
#[derive(Debug, Serialize, JsonSchema)]
pub struct PassedOver {
    /// The thing.
    #[serde(flatten)]
    pub thing: Target,
    /// Why there is no place.
    pub why: NoGoal,
}

/// The thing that the places are near.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Target {
    /// Its name within this generation.
    pub id: String,
    /// Its middle.
    pub position_in_world: [f64; 3],
}

/// A place to stand that the robot reaches, and from which it sees the thing.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Stand {
    /// The ground below the robot's middle, metres.
    pub position_in_world: [f64; 3],
    /// Where the robot looks: radians from the world's x axis towards y.
    pub yaw_rad: f64,
    /// The same as a quaternion x, y, z, w.
    pub orientation_xyzw: [f64; 4],
    /// Distance from the robot's middle to what it must not touch, metres.
    pub clearance_m: f64,
    /// Share of the thing that is seen from there, 0 to 1.
    pub visible_share: f64,
    /// Length of the way, metres.
    pub way_m: f64,
    /// Latitude and longitude (WGS 84), where the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lat_lon_deg: Option<[f64; 2]>,
}

impl Going {
    pub fn parameters(&self) -> Vec<(&'static str, String)> {
        let number = |name, value: Option<f64>| value.map(|value| (name, value.to_string()));
        let near = self.near.map(|near| ("near", xyz(near)));
        let robot = [
            number("heading_rad", self.heading_rad),
            number("radius_m", self.radius_m),
            number("reach_m", self.reach_m),
            number("sensor_height_m", self.sensor_height_m),
        ];
        let of = if parse_public_id(&self.what).is_some() { "id" } else { "text" };
        [Some((of, self.what.clone())), near].into_iter().chain(robot).flatten().collect()
    }
}

impl From<GoalReply> for Stands {
    fn from(goals: GoalReply) -> Self {
        let stand = |goal: Goal| Stand {
            position_in_world: goal.position_in_world.to_array(),
            yaw_rad: goal.yaw_rad,
            orientation_xyzw: goal.orientation_xyzw,
            clearance_m: goal.clearance_m,
            visible_share: goal.visible_share,
            way_m: goal.path_m,
            lat_lon_deg: goal.geographic.map(|place| [place.latitude_deg, place.longitude_deg]),
        };
        let target =
            |of: TargetThing| Target { id: of.id, position_in_world: of.position_in_world.to_array() };
        let missed = goals.missed.into_iter();
        Self {
            scene: goals.scene,
            generation: goals.generation,
            passed_over: missed.map(|of| PassedOver { thing: target(of.thing), why: of.none }).collect(),
            thing: goals.thing.map(target),
            places: goals.goals.into_iter().map(stand).collect(),
            none: goals.none,
        }
    }
}
